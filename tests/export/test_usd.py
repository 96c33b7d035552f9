"""USDZ read back by Pixar's own library: axes, place, texture, and the rules of Apple's viewers."""

from __future__ import annotations

import zipfile
from pathlib import Path

import cv2
import numpy as np
import pytest

from fieldfuse.camera import Similarity
from fieldfuse.errors import InputError
from fieldfuse.export.atlas import make_atlas
from fieldfuse.export.usd import Y_UP, write_usdz
from fieldfuse.tsdf.mesh import Mesh
from tests.export.samples import coloured_ball, turned

pxr = pytest.importorskip("pxr", reason="the extra `usd` is not installed")


def faults(path: Path) -> list[str]:
    """What Pixar's checks find against a package for Apple's viewers."""
    from pxr import UsdUtils

    if not hasattr(UsdUtils, "ComplianceChecker"):  # of later versions
        from pxr import Usd, UsdValidation

        registry = UsdValidation.ValidationRegistry()
        every = registry.GetOrLoadValidatorsByName([data.name for data in registry.GetAllValidatorMetadata()])
        return [error.GetMessage() for error in UsdValidation.ValidationContext(every).Validate(Usd.Stage.Open(str(path)))]
    checker = UsdUtils.ComplianceChecker(arkit=True, skipVariants=False)
    checker.CheckCompliance(str(path))
    return [*checker.GetErrors(), *checker.GetFailedChecks(), *checker.GetWarnings()]


@pytest.mark.parametrize("far", [0.0, 4e6])
def test_a_package_is_valid_upright_and_in_place(tmp_path: Path, far: float) -> None:
    from pxr import Gf, Usd, UsdGeom, UsdShade

    there = turned()
    working = Similarity(there.scale, there.rotation, there.translation + there.scale * (there.rotation @ [far, -far, far]))
    back = working.inverse()
    mesh = coloured_ball(2).transformed(turned())
    atlas = make_atlas(mesh, 40.0, 512)
    texture = np.random.default_rng(0).integers(0, 256, (atlas.size, atlas.size, 3)).astype(np.uint8)
    texture = cv2.GaussianBlur(texture, (0, 0), 4)
    path = tmp_path / "ball.usdz"
    write_usdz(path, mesh, atlas, texture, working)
    assert faults(path) == []
    stage = Usd.Stage.Open(str(path))
    assert UsdGeom.GetStageUpAxis(stage) == "Y" and UsdGeom.GetStageMetersPerUnit(stage) == 1.0
    shape = UsdGeom.Mesh(stage.GetPrimAtPath("/Field/Mesh"))
    points = np.asarray(shape.GetPointsAttr().Get(), dtype=np.float64)

    def moved(matrix: Gf.Matrix4d, values: np.ndarray) -> np.ndarray:
        return (np.concatenate([values, np.ones((len(values), 1))], axis=1) @ np.array(matrix))[:, :3]

    cache = UsdGeom.XformCache()
    wanted = back.points(mesh.vertices)
    own, _ = shape.GetLocalTransformation(), None
    assert np.abs(moved(own, points) - wanted).max() < 1e-6 * np.ptp(wanted, axis=0).max() + 1e-9 * far
    shown = moved(cache.GetLocalToWorldTransform(shape.GetPrim()), points)
    working_size = (mesh.vertices - mesh.vertices.mean(axis=0)) / working.scale @ Y_UP.T
    assert np.abs(shown - shown.mean(axis=0) - working_size + working_size.mean(axis=0)).max() < 1e-4
    assert abs(shown[:, 1].min()) < 1e-4 and np.abs(shown[:, [0, 2]].min(axis=0) + shown[:, [0, 2]].max(axis=0)).max() < 1e-4
    assert np.array_equal(np.asarray(shape.GetFaceVertexIndicesAttr().Get()).reshape(-1, 3), mesh.triangles)
    st = UsdGeom.PrimvarsAPI(shape).GetPrimvar("st")
    assert st.GetInterpolation() == "faceVarying"
    assert np.abs(np.asarray(st.Get()) - atlas.coordinates().reshape(-1, 2)).max() < 1e-6
    material = UsdShade.MaterialBindingAPI(shape.GetPrim()).ComputeBoundMaterial()[0]
    surface = material.ComputeSurfaceSource()[0]
    picture = UsdShade.Shader(surface.GetInput("emissiveColor").GetConnectedSources()[0][0].source.GetPrim())
    name = picture.GetInput("file").Get().path
    with zipfile.ZipFile(path) as package:
        assert package.testzip() is None and package.namelist()[0].endswith(".usdc")
        inside = cv2.imdecode(np.frombuffer(package.read(name), np.uint8), cv2.IMREAD_COLOR)
    assert inside is not None and np.abs(inside[..., ::-1].astype(int) - texture).mean() < 2


def test_the_same_mesh_gives_the_same_bytes_and_what_cannot_be_written_is_refused(tmp_path: Path) -> None:
    mesh = coloured_ball(1)
    atlas = make_atlas(mesh, 5.0, 256)
    texture = np.full((atlas.size, atlas.size, 3), 90, np.uint8)
    for name in ("a.usdz", "b.usdz"):
        write_usdz(tmp_path / name, mesh, atlas, texture, Similarity.identity())
    assert (tmp_path / "a.usdz").read_bytes() == (tmp_path / "b.usdz").read_bytes()
    with pytest.raises(InputError, match="no triangles"):
        write_usdz(tmp_path / "c.usdz", Mesh.empty(), atlas, texture, Similarity.identity())
    with pytest.raises(InputError, match=r"written as \.usdz"):
        write_usdz(tmp_path / "c.usd", mesh, atlas, texture, Similarity.identity())
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.usdz", "b.usdz"]
