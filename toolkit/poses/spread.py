"""Tasks of structure from motion on the nodes of a Ray cluster. Each leaves a file in a folder that all nodes see, and the child process
puts these into its database in their order: what is found depends neither on how many nodes there are nor on which was done first.

Files that an interrupted run left are used. Runs in the child process only.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from fieldfuse.cluster import Task, open_workers
from fieldfuse.cluster.tasks import Function
from fieldfuse.errors import FieldfuseError
from fieldfuse.poses.child import alive
from fieldfuse.poses.job import Job

FOLDER = "tasks"  # in the job's, until what it holds is in the database


def spread(job: Job, function: Function, tasks: Sequence[Task], show: Callable[[float], None], alone: int) -> bool:
    """Have the job's cluster run those tasks whose files, the last of their arguments, are not there yet.

    Args:
        show: gets how many are done, with parts of those that run.
        alone: tasks that this machine does at a time without the cluster.

    Returns:
        whether all files are there; False: the cluster would do no more tasks at a time, and nothing was done.

    Raises:
        InputError: the cluster cannot be used, or a node does not see the job's folder or images.
        FieldfuseError: a task could not be done; files of the others are kept.
    """
    left = [task for task in tasks if not Path(task.argument[-1]).is_file()]
    if not left:
        return True
    with open_workers(job.address) as workers:
        if workers.at_once(left[0]) <= alone:
            return False
        workers.check(Path(job.folder), sorted({image.image for image in (job.images[0], job.images[-1])}))
        said = 0.0

        def listen(done: float) -> None:
            nonlocal said
            said = done
            show(len(tasks) - len(left) + done)

        with alive(lambda: listen(said)):  # tasks may wait long for others' to end
            failed = workers.finish(function, left, listen)
    if failed:
        raise FieldfuseError(f"{failed[0]}; {len(tasks) - len(failed)} of {len(tasks)} tasks are kept, run the same command again")
    return True
