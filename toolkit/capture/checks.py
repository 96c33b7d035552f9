from toolkit.capture.types import Capture
from toolkit.progress import SILENT, Progress


def check_capture(capture: Capture, progress: Progress = SILENT) -> Capture:
    return capture
