"""Samples of what is learnt or baked: baked fields, weights, scene files, shards, checkpoints, depth by matching, speeds of machines."""

from __future__ import annotations

import os
from dataclasses import asdict
from pathlib import Path

import numpy as np
import torch

from fieldfuse.camera import Intrinsics
from fieldfuse.evaluation import budget
from fieldfuse.files import write_json
from fieldfuse.nerfusion.model import ModelConfig, NerfusionModel
from fieldfuse.nerfusion.training.checkpoint import TrainState, load_checkpoint, save_checkpoint
from fieldfuse.nerfusion.training.scenes import ShardScene, write_shard
from fieldfuse.nerfusion.training.settings import load_train_settings
from fieldfuse.nerfusion.weights import load_model, save_model
from fieldfuse.render.bake import bake
from fieldfuse.render.bake_file import read_baked, write_baked
from fieldfuse.render.image import render_view
from fieldfuse.simulate.settings import read_scene_file
from fieldfuse.stereo.maps import load_stereo, save_stereo
from fieldfuse.stereo.match import StereoDepth
from fieldfuse.stereo.transients import LeftOut, load_left_out, save_left_out
from tests.nerfusion.training.tiny import tiny_settings
from tests.stability.hard.fields import small_field


def make_models(root: Path) -> None:
    """A baked field, networks' weights, and a scene file."""
    root.mkdir(parents=True)
    write_baked(root / "bounded.safetensors", bake(small_field(1, 0.2)))
    write_baked(root / "background.safetensors", bake(small_field(2, 0.3, shell=1.0)))
    save_model(root / "weights.safetensors", NerfusionModel(ModelConfig(channels=4, hidden=4, gru_hidden=4)))
    scene = "scene: room\npath: {kind: walk, frames: 60, fps: 10, speed: 0.5, shake: 2}\neffects:\n  - exposure: {stops: 0.5}\n"
    (root / "scene.yaml").write_text(scene)


def read_baked_field(root: Path, number: int) -> None:
    """Open a baked field and look at it from outside and from inside."""
    field = read_baked(root / ("bounded.safetensors", "background.safetensors")[number % 2]).to_field()
    camera = Intrinsics(12, 9, 10.0, 10.0, 6.0, 4.5)
    for distance in (3.0, 0.3):
        pose = np.eye(4)
        pose[:3, 3] = 0.1, -0.2, 0.3 - distance
        picture = render_view(field, camera, pose)
        if not np.isfinite(picture.rgb).all():
            raise ValueError("a colour that is not finite")


def read_models(root: Path, number: int) -> None:

    if number % 2:
        load_model(root / "weights.safetensors")
    else:
        read_scene_file(root / "scene.yaml")


def make_training(root: Path) -> None:
    """A shard of training pictures, a checkpoint, settings, depth by matching, and what is remembered of a machine."""
    from fieldfuse.nerfusion.training.train import make_model  # here, for workers that read other things: it brings matplotlib

    root.mkdir(parents=True)
    rng = np.random.default_rng(0)
    pictures, depths = rng.integers(0, 255, (4, 3, 12, 16), dtype=np.uint8), np.ones((4, 12, 16), np.float32)
    cameras, poses = np.tile([15.0, 15.0, 8.0, 6.0], (4, 1)), np.tile(np.eye(4), (4, 1, 1))
    write_shard(root / "shard.safetensors", pictures, depths, cameras, poses, kind="room", ordered=True)
    settings = tiny_settings()
    model = make_model(settings)
    adam = torch.optim.Adam(model.parameters())
    for parameter in model.parameters():
        parameter.grad = torch.zeros_like(parameter)
    adam.step()
    save_checkpoint(root, TrainState(model, adam, step=7), asdict(settings), 1)
    (root / "train.yaml").write_text(
        "seed: 3\nstage: {steps: 10, fused_steps: 5}\noptimiser: {rate: 1e-3}\nsources:\n  - {kind: procedural}\n"
    )
    camera = Intrinsics(16, 12, 15.0, 15.0, 8.0, 6.0)
    save_stereo(root / "depths.safetensors", ["a", "b"], [StereoDepth(depths[0], depths[0], camera)] * 2)
    save_left_out(root / "left_out.safetensors", LeftOut.of(["a", "b"], [rng.random((12, 16)) < 0.5] * 2, 0.5))
    speed = {"units": dict.fromkeys(budget.KINDS, 1.0), "factors": dict.fromkeys(budget.COST, 1.0)}
    (root / "fieldfuse").mkdir()
    write_json(root / "fieldfuse" / "speed.json", {"machine": speed})


def read_training(root: Path, number: int) -> None:
    """Each file by its own reader; a file of speeds that is damaged counts as none."""
    from fieldfuse.nerfusion.training.train import make_model

    os.environ["XDG_CACHE_HOME"] = str(root)
    budget.remembered("machine")
    load_train_settings(root / "train.yaml")
    scene = ShardScene(root / "shard.safetensors", 8)
    scene.pictures([0, 3])
    load_stereo(root / "depths.safetensors")
    load_left_out(root / "left_out.safetensors")
    model = make_model(tiny_settings())
    path = root / "checkpoint-0000007.safetensors"
    load_checkpoint(path, TrainState(model, torch.optim.Adam(model.parameters())))
    if not all(bool(torch.isfinite(parameter).all()) for parameter in model.parameters()):
        raise ValueError("a weight that is not finite")
