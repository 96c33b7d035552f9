"""The faults: each one line of the product, and what it becomes.

A fault is found by its text, wherever it lies: an anchor must occur exactly once in the product. Where a line was written differently in
another state of the repository, a fault has several anchors, and the first that occurs is taken.
"""

from __future__ import annotations

from dataclasses import dataclass

Anchor = tuple[str, str]  # the text in the product, and what is put in its place


@dataclass(frozen=True)
class Fault:
    """One thing done wrong in one place.

    Attributes:
        name: what goes wrong.
        kind: of mistake, as a programmer makes it.
        anchors: texts of one line and their replacements, the first that occurs counts.
    """

    name: str
    kind: str
    anchors: tuple[Anchor, ...]


def fault(name: str, kind: str, *anchors: Anchor) -> Fault:
    return Fault(name, kind, anchors)


FAULTS = (
    # Cameras, colours, files
    fault("centre of K not moved by half a pixel", "wrong constant", ("[0, self.fy, self.cy - 0.5]", "[0, self.fy, self.cy]")),
    fault(
        "vertical centre scaled by the width",
        "swapped axis",
        ("fy=self.fy * sy, cx=self.cx * sx, cy=self.cy * sy", "fy=self.fy * sy, cx=self.cx * sx, cy=self.cy * sx"),
    ),
    fault(
        "inverse pose with its translation's sign lost",
        "wrong sign",
        ('= -np.einsum("...ij,...j->...i", rotation, pose[..., :3, 3])', '= np.einsum("...ij,...j->...i", rotation, pose[..., :3, 3])'),
    ),
    fault("sRGB decoded with 2.2 for 2.4", "wrong constant", ("((shown + 0.055) / 1.055) ** 2.4", "((shown + 0.055) / 1.055) ** 2.2")),
    # Capture
    fault(
        "principal point of calibration files not moved",
        "off by one",
        ("return Intrinsics(width, height, fx, fy, cx + 0.5, cy + 0.5)", "return Intrinsics(width, height, fx, fy, cx, cy)"),
    ),
    fault(
        "quaternion with w last",
        "swapped arguments",
        ("(quaternion / length)[[1, 2, 3, 0]]", "(quaternion / length)[[0, 1, 2, 3]]"),
        ("w, x, y, z = quaternion / length", "x, y, z, w = quaternion / length"),
    ),
    fault(
        "TUM depth with Kinect's unit",
        "wrong unit",
        ("DEPTH_SCALE = 5000.0", "DEPTH_SCALE = 1000.0"),
        ("depth_scale=5000.0", "depth_scale=1000.0"),
    ),
    fault(
        "DTU projection's sign test",
        "wrong comparison",
        ("if np.linalg.det(projection[:, :3] / scale) < 0:", "if np.linalg.det(projection[:, :3] / scale) > 0:"),
    ),
    fault(
        "depth unit without the applied scale",
        "skipped step",
        ("return 1.0 / (factor * applied_scale)", "return 1.0 / factor"),
        ("or 1e-3) * (applied_scale or 1.0)", "or 1e-3)"),
    ),
    fault(
        "farther surface wins where depth is carried over",
        "wrong comparison",
        ("if out[row, column] == 0 or z[y, x] < out[row, column]:", "if out[row, column] == 0 or z[y, x] > out[row, column]:"),
    ),
    fault(
        "links out of a capture's folder",
        "dropped guard",
        ("if not resolved.is_relative_to(root) and Path(os.path.normpath(root / relative)).is_relative_to(root):", "if False:"),
    ),
    fault("size of text files", "dropped guard", ("if path.stat().st_size > max_bytes:", "if False:")),
    fault(
        "EXIF orientation 5 to 8 not transposed",
        "skipped step",
        ("picture = picture.swapaxes(0, 1)", "picture = picture[:, :]"),
        ("image = image.swapaxes(0, 1)", "image = image[:, :]"),
    ),
    fault(
        "focal length of a camera angle",
        "wrong constant",
        ("return 0.5 * length / math.tan(0.5 * angle)", "return 0.5 * length / math.tan(angle)"),
    ),
    fault(
        "frames chosen for blur",
        "wrong comparison",
        ("is None or score[index] > score[", "is None or score[index] < score["),
    ),
    # Poses
    fault("scale of a sensor not applied to poses", "skipped step", ("poses[:, :3, 3] *= scale", "poses[:, :3, 3] *= 1.0")),
    fault(
        "up direction downwards",
        "wrong sign",
        ("mean = -world_from_camera[:, :3, 1].mean(axis=0)", "mean = world_from_camera[:, :3, 1].mean(axis=0)"),
    ),
    fault(
        "turn about z the other way",
        "wrong sign",
        ("np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])", "np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])"),
    ),
    fault(
        "frames of a video matched past its end",
        "off by one",
        ("for i in range(count) for step in steps if i + step < count]", "for i in range(count) for step in steps if i + step <= count]"),
    ),
    # Effects
    fault(
        "vignetting's power",
        "wrong constant",
        ("(1 + (effect.corner**-0.5 - 1) * radius.square()) ** -2", "(1 + (effect.corner**-0.5 - 1) * radius.square()) ** -1"),
        ("np.asarray((1 + (corner**-0.5 - 1) * square) ** -2)", "np.asarray((1 + (corner**-0.5 - 1) * square) ** -1)"),
    ),
    fault(
        "rows of a rolling shutter from its start",
        "off by one",
        (".readout * ((np.arange(height) + 0.5) / height - 0.5)", ".readout * ((np.arange(height) + 0.5) / height)"),
    ),
    fault(
        "tangential distortion p1 for p2",
        "swapped arguments",
        ("bent_x = x * radial + 2 * effect.p1 * x * y + effect.p2 *", "bent_x = x * radial + 2 * effect.p2 * x * y + effect.p1 *"),
        ("bent_x = x * radial + 2 * self.p1 * x * y + self.p2 *", "bent_x = x * radial + 2 * self.p2 * x * y + self.p1 *"),
    ),
    fault(
        "depth noise linear in depth",
        "wrong constant",
        (".sigma * z**2", ".sigma * z"),
    ),
    # Stereo
    fault(
        "depth kept although others see through it",
        "dropped guard",
        ("kept = (depth > 0) & (agree >= needed) & (agree > through)", "kept = (depth > 0) & (agree >= needed)"),
        ("(found.agree >= needed) & (found.agree > found.through)", "(found.agree >= needed)"),
    ),
    fault("correlation without the windows' means", "skipped step", ("(product * part_of - mean[x] * their)", "(product * part_of)")),
    # Volume
    fault(
        "contraction's shell",
        "wrong sign",
        (
            "return points * ((1.0 + self.shell - self.shell / norm) / norm)",
            "return points * ((1.0 + self.shell + self.shell / norm) / norm)",
        ),
    ),
    fault(
        "interpolation with x and z exchanged", "swapped axis", ("wx = torch.stack([1 - fx, fx], 1)", "wx = torch.stack([1 - fz, fz], 1)")
    ),
    # NeRFusion
    fault(
        "projection divided by nothing",
        "skipped step",
        ("pixels = local[..., :2] / safe[..., None] * focal + middle", "pixels = local[..., :2] * focal + middle"),
    ),
    fault(
        "variance over the views not squared",
        "wrong constant",
        ("variance = ((values - mean).square() * share).sum(0)", "variance = ((values - mean).abs() * share).sum(0)"),
    ),
    fault(
        "reset gate left out",
        "skipped step",
        ("self.candidate(_beside(r * state, local)", "self.candidate(_beside(state, local)"),
        ("self.candidate(_beside(r * h, v)", "self.candidate(_beside(h, v)"),
    ),
    fault(
        "update gate's count with the wrong sign",
        "wrong sign",
        ("z, r = torch.sigmoid(update - known), torch.sigmoid(reset)", "z, r = torch.sigmoid(update + known), torch.sigmoid(reset)"),
    ),
    fault(
        "key frames chosen when both are low",
        "wrong comparison",
        ("np.all((angle > min_parallax) | (common < max_overlap))", "np.all((angle > min_parallax) & (common < max_overlap))"),
        ("> MIN_PARALLAX) | (common[i, chosen] < MAX_OVERLAP)", "> MIN_PARALLAX) & (common[i, chosen] < MAX_OVERLAP)"),
    ),
    fault(
        "depth likelihood's window",
        "wrong constant",
        ("window = torch.exp(-0.5 * ((traced.distance - true)", "window = torch.exp(-2.0 * ((traced.distance - true)"),
    ),
    fault(
        "opacity loss pulls to zero",
        "wrong sign",
        ("solid, (1 - traced.opacity).square(), 0.0)", "solid, traced.opacity.square(), 0.0)"),
    ),
    fault("warm-up off by one", "off by one", (".rate * (step + 1) / ", ".rate * step / ")),
    fault("DTU's volumes in millimetres", "wrong unit", ("MILLIMETRES = 1 / 200", "MILLIMETRES = 1 / 1000")),
    fault(
        "rays through pixel corners",
        "off by one",
        (
            "local = torch.stack([(column + 0.5 - cx) / fx, (row + 0.5 - cy) / fy,",
            "local = torch.stack([(column - cx) / fx, (row - cy) / fy,",
        ),
    ),
    # Render
    fault("samples' own thickness counted before them", "off by one", ("before = total - values.double()", "before = total")),
    fault(
        "background over everything",
        "skipped step",
        ("colour = colour + (1 - opacity)[:, None] * field.background", "colour = colour + field.background[None]"),
        ("colour = shown.colour + (1 - shown.opacity)[:, None] * field.background", "colour = shown.colour + field.background[None]"),
    ),
    # Per-scene fit
    fault(
        "Adam's second moment not squared",
        "wrong constant",
        (
            "second.mul_(self.decay).addcmul_(gradient, gradient, value=1 - self.decay)",
            "second.mul_(self.decay).add_(gradient.abs(), alpha=1 - self.decay)",
        ),
    ),
    fault(
        "importance weights not undone",
        "skipped step",
        ("return picks, 1 / self.density[self.tiles(picks)]", "return picks, torch.ones_like(self.density[self.tiles(picks)])"),
    ),
    fault(
        "training rays' row and column exchanged",
        "swapped axis",
        ("u, v = column.float() + 0.5, row.float() + 0.5", "u, v = row.float() + 0.5, column.float() + 0.5"),
    ),
    fault(
        "depth along z taken for distance",
        "skipped step",
        ("np.where(np.isfinite(depth) & (depth > 0), depth * length, 0)", "np.where(np.isfinite(depth) & (depth > 0), depth, 0)"),
    ),
    # Kernels
    fault(
        "numba: weight of thin samples",
        "wrong sign",
        ("tau * (ONE - tau * HALF * (ONE - tau * THIRD))", "tau * (ONE + tau * HALF * (ONE - tau * THIRD))"),
        ("return before * tau * (ONE - tau * HALF * (ONE", "return before * tau * (ONE + tau * HALF * (ONE"),
    ),
    fault(
        "numba: lazy Adam's step",
        "wrong sign",
        ("feature[row, c] -= step * g / (np.sqrt(v) + epsilon)", "feature[row, c] += step * g / (np.sqrt(v) + epsilon)"),
    ),
    fault(
        "numba: children of a split voxel", "off by one", ("return int(np.ceil(index * ratio - 0.5))", "return int(np.ceil(index * ratio))")
    ),
    fault(
        "Triton: opacity's gradient", "wrong sign", ("g_opacity += g_mixed * (colour - behind)", "g_opacity -= g_mixed * (colour - behind)")
    ),
    fault("Triton: the GRU's mean", "wrong comparison", ("z = w / (w + tl.minimum(known, most))", "z = w / (w + tl.maximum(known, most))")),
    fault("Triton: bias of Adam's moment", "skipped step", ("unbias = tl.sqrt(1 - tl.exp2(step * log_decay))", "unbias = 1.0 + 0 * step")),
    # TSDF, export
    fault(
        "poses of depth frames not in the working frame",
        "skipped step",
        ("pose = working_from_input.poses(frame.world_from_camera)", "pose = frame.world_from_camera"),
    ),
    fault(
        "texture of what is hidden",
        "dropped guard",
        ("seen = inside & (local[:, 2] <= depth[row, column] * (1 + BEHIND)) & (cosine > 0)", "seen = inside & (cosine > 0)"),
    ),
    fault(
        "COLMAP's place with the wrong sign",
        "wrong sign",
        ("*quaternion(pose[:3, :3]), *pose[:3, 3]]", "*quaternion(pose[:3, :3]), *-pose[:3, 3]]"),
    ),
    # Evaluation
    fault("PSNR in half decibels", "wrong constant", ("float(-10 * np.log10(error))", "float(-20 * np.log10(error))")),
    fault("SSIM's covariance", "skipped step", ("(first * second) - m1 * m2", "(first * second)")),
    fault(
        "F-score as the arithmetic mean",
        "wrong constant",
        ("2 * precision * recall / (precision + recall) if", "(precision + recall) / 2 if"),
    ),
    fault(
        "Pareto front of the worst",
        "wrong comparison",
        (
            "if not front or better(point.mean[measure], front[-1].mean[measure]):",
            "if not front or better(front[-1].mean[measure], point.mean[measure]):",
        ),
        ("sign * point.mean[measure] > sign * front[-1]", "sign * point.mean[measure] < sign * front[-1]"),
    ),
    # Simulation
    fault(
        "simulated depth along the ray",
        "wrong unit",
        ("depth = torch.where(hit, seen.distance * eye.cosine, 0.0)", "depth = torch.where(hit, seen.distance, 0.0)"),
        ("seen.distance * eye.cosine.repeat(count), 0.0)", "seen.distance, 0.0)"),
    ),
    fault(
        "cylinders without an end",
        "dropped guard",
        (
            "return torch.where(hit & (enter <= leave) & (enter > NEAREST), enter, FAR)",
            "return torch.where(hit & (enter > NEAREST), enter, FAR)",
        ),
        ("if enter <= leave and NEAREST < reached < best:", "if NEAREST < reached < best:"),
    ),
    fault(
        "people who pass before what stands",
        "wrong sign",
        (
            "passed = (seen > 0) & ((depth == 0) | (seen < depth - PASSED))",
            "passed = (seen > 0) & ((depth == 0) | (seen > depth + PASSED))",
        ),
    ),
    # Commands and run folders
    fault(
        "steps not made again for other settings",
        "dropped guard",
        ("(trusted or (record.key == key and not record.stopped))", "(trusted or not record.stopped)"),
        ("return trusted or (record.key == key and not record.stopped)", "return trusted or not record.stopped"),
    ),
    fault(
        "damaged results of a step reused",
        "dropped guard",
        ("if not path.is_file() or path.stat().st_size != size:", "if not path.is_file():"),
        ("all(path.is_file() and path.stat().st_size == size for", "all(path.is_file() for"),
    ),
    fault("a run written over its own source", "dropped guard", ("if source.resolve() == out.resolve():", "if False:")),
    fault(
        "a run over another capture's",
        "wrong comparison",
        ("if before.resolve() == source.resolve():", "if before.resolve() != source.resolve():"),
    ),
    fault(
        "somebody's files in the run's folder",
        "dropped guard",
        ("foreign = self._results()", "foreign: list[str] = []"),
        ("if not self._held_run and (foreign := self._results()):", "if (foreign := self._results()) == [None]:"),
    ),
    fault(
        "renders of the wrong size",
        "wrong comparison",
        ("factor = long_side / max(lens.width, lens.height)", "factor = long_side / min(lens.width, lens.height)"),
    ),
    fault(
        "depth pictures in working units",
        "wrong unit",
        ("return 1 / (scene.working_from_input.scale * depth_step(scene))", "return 1 / depth_step(scene)"),
    ),
)
