from benchmarks.experiment import program
from benchmarks.mutation.measure import app

program(app)
