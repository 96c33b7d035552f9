"""A textured mesh as USDZ, which phones show in a room (AR Quick Look) and film programs read: by Pixar's usd-core (the extra `usd`)."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from fieldfuse.camera import Array, Similarity
from fieldfuse.errors import InputError, OutputError, first_line
from fieldfuse.export.atlas import Atlas
from fieldfuse.export.extras import require
from fieldfuse.export.mesh import packed_texture
from fieldfuse.export.ply import single_precision
from fieldfuse.files import atomic_path
from fieldfuse.tsdf.mesh import Mesh

Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])  # of axes whose z is up
LAYER, PICTURE = "textured.usdc", "textured.jpg"  # inside the package


def write_usdz(path: Path | str, mesh: Mesh, atlas: Atlas, texture: Array, working_from_input: Similarity) -> None:
    """Write a mesh (working frame, z up, with normals) with its texture (S, S, 3) uint8 as one .usdz file.

    The prim `/Field/Mesh` has the input's frame and unit; `/Field` turns it so that y is up, and moves it so that it stands on the
    origin's floor, where programs for augmented reality put it. One unit is taken as a metre, which holds where the capture is metric.
    What is lit is in the images already, so the material gives light and reflects none.

    Raises:
        InputError: an empty mesh, another suffix, or the extra `usd` is not installed.
        OutputError: the file cannot be written.
    """
    path = Path(path)
    if path.suffix.lower() != ".usdz":
        raise InputError(f"this mesh is written as .usdz, not {path.suffix or 'without a suffix'}; rename {path.name}")
    if len(mesh.triangles) == 0:
        raise InputError(f"the mesh has no triangles, which {path.name} cannot hold; check the depth it was made from")
    require("usdz")
    from pxr import Sdf, Tf

    turn = Y_UP @ working_from_input.rotation
    mesh = mesh.transformed(working_from_input.inverse())
    upright = mesh.vertices @ turn.T
    low, high = upright.min(axis=0), upright.max(axis=0)
    root = np.eye(4)
    root[:3, :3] = turn
    root[:3, 3] = -np.array([0.5 * (low[0] + high[0]), low[1], 0.5 * (low[2] + high[2])])
    try:
        with tempfile.TemporaryDirectory() as folder, atomic_path(path) as temporary:
            layer, picture = Path(folder) / LAYER, Path(folder) / PICTURE
            picture.write_bytes(packed_texture(texture))
            _write_layer(layer, mesh, atlas, root)
            with Sdf.ZipFileWriter.CreateNew(str(temporary)) as package:
                for file in (layer, picture):  # the layer has to come first
                    package.AddFile(str(file), file.name)
    except Tf.ErrorException as error:
        raise OutputError(f"cannot write {path}: {first_line(error)}; free space or choose another folder") from error


def _write_layer(path: Path, mesh: Mesh, atlas: Atlas, root: Array) -> None:
    from pxr import Gf, Sdf, Usd, UsdGeom, Vt

    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    top = UsdGeom.Xform.Define(stage, "/Field")
    top.AddTransformOp().Set(Gf.Matrix4d(*root.T.ravel().tolist()))  # USD multiplies rows from the left
    stage.SetDefaultPrim(top.GetPrim())
    shape = UsdGeom.Mesh.Define(stage, "/Field/Mesh")
    offset = np.zeros(3) if single_precision(mesh.vertices) else mesh.bounds().mean(axis=0)  # USD's points are float32
    if offset.any():
        shape.AddTranslateOp(UsdGeom.XformOp.PrecisionDouble).Set(Gf.Vec3d(*offset.tolist()))
    points = np.ascontiguousarray(mesh.vertices - offset, dtype=np.float32)
    shape.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(points))
    shape.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(np.stack([points.min(axis=0), points.max(axis=0)])))
    shape.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(mesh.triangles), 3, np.int32)))
    shape.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(np.ascontiguousarray(mesh.triangles.reshape(-1), dtype=np.int32)))
    shape.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    shape.CreateDoubleSidedAttr(True)  # what was seen from one side has no back
    if mesh.normals is not None:
        shape.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(mesh.normals, dtype=np.float32)))
        shape.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    st = UsdGeom.PrimvarsAPI(shape).CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray, UsdGeom.Tokens.faceVarying)
    st.Set(Vt.Vec2fArray.FromNumpy(np.ascontiguousarray(atlas.coordinates().reshape(-1, 2), dtype=np.float32)))
    _bind_unlit(stage, shape.GetPrim())
    stage.GetRootLayer().Save()


def _bind_unlit(stage: Any, prim: Any) -> None:
    """A material that shows the picture whatever the light: it gives the light itself, and with the refraction of air reflects none."""
    from pxr import Sdf, UsdShade

    material = UsdShade.Material.Define(stage, "/Field/Material")

    def shader(name: str, kind: str) -> Any:
        made = UsdShade.Shader.Define(stage, f"/Field/Material/{name}")
        made.CreateIdAttr(kind)
        return made

    types = Sdf.ValueTypeNames
    reader, picture = shader("Places", "UsdPrimvarReader_float2"), shader("Picture", "UsdUVTexture")
    surface = shader("Surface", "UsdPreviewSurface")
    reader.CreateInput("varname", types.String).Set("st")
    places = reader.CreateOutput("result", types.Float2)
    picture.CreateInput("file", types.Asset).Set(PICTURE)
    picture.CreateInput("sourceColorSpace", types.Token).Set("sRGB")
    for side in ("wrapS", "wrapT"):
        picture.CreateInput(side, types.Token).Set("clamp")
    picture.CreateInput("st", types.Float2).ConnectToSource(places)
    surface.CreateInput("emissiveColor", types.Color3f).ConnectToSource(picture.CreateOutput("rgb", types.Float3))
    surface.CreateInput("diffuseColor", types.Color3f).Set((0.0, 0.0, 0.0))
    for name, value in (("roughness", 1.0), ("metallic", 0.0), ("ior", 1.0)):
        surface.CreateInput(name, types.Float).Set(value)
    material.CreateSurfaceOutput().ConnectToSource(surface.CreateOutput("surface", types.Token))
    UsdShade.MaterialBindingAPI.Apply(prim).Bind(material)
