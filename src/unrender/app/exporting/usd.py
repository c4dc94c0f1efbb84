"""USD: one .usdz file with meshes, materials (UsdPreviewSurface) and maps."""

from __future__ import annotations

import importlib
import importlib.util
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from unrender.app.exporting import textures
from unrender.app.exporting.asset import Asset, Part
from unrender.core.errors import InputError
from unrender.display.pictures import png

FILE = "asset.usdz"


def check_installed() -> None:
    """Raise `InputError` if the package that writes USD is missing."""
    if importlib.util.find_spec("pxr") is None:
        raise InputError("--format usd needs usd-core: pip install 'unrender[usd]'")


def _module(name: str) -> Any:
    """Import a module of USD, which has no type annotations."""
    return importlib.import_module(f"pxr.{name}")


def write(asset: Asset, folder: Path) -> None:
    """Write asset.usdz without light. As in UsdPreviewSurface, +Y and v point upwards and roughness is perceptual.

    Raises `InputError` if usd-core is missing.
    """
    check_installed()
    Usd, UsdGeom, UsdUtils = map(_module, ("Usd", "UsdGeom", "UsdUtils"))

    with tempfile.TemporaryDirectory() as scratch:
        place = Path(scratch)
        stage: Any = Usd.Stage.CreateNew(str(place / "asset.usdc"))
        UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
        UsdGeom.SetStageMetersPerUnit(stage, 1.0)
        root = UsdGeom.Xform.Define(stage, "/asset")
        stage.SetDefaultPrim(root.GetPrim())
        for index, part in enumerate(asset.parts):
            _add(stage, f"/asset/part_{index}", part, place)
        stage.GetRootLayer().Save()
        if not UsdUtils.CreateNewUsdzPackage(str(place / "asset.usdc"), str(folder / FILE)):
            raise InputError("export: USD could not pack its file")


def _add(stage: Any, path: str, part: Part, place: Path) -> None:
    Sdf, UsdGeom, UsdShade, Vt = map(_module, ("Sdf", "UsdGeom", "UsdShade", "Vt"))

    mesh: Any = UsdGeom.Mesh.Define(stage, path)
    mesh.GetPrim().SetDisplayName(part.name)
    mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(part.vertices, np.float32)))
    mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(np.ascontiguousarray(part.faces.ravel(), np.int32)))
    mesh.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(part.faces), 3, np.int32)))
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    mesh.CreateDoubleSidedAttr(part.material.two_sided)
    mesh.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(np.stack([part.vertices.min(0), part.vertices.max(0)])))
    if part.normals is not None:
        mesh.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(part.normals, np.float32)))
        mesh.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    if part.uv is not None:
        upwards = np.stack([part.uv[:, 0], 1 - part.uv[:, 1]], 1).astype(np.float32)
        kind = Sdf.ValueTypeNames.TexCoord2fArray
        UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("st", kind, UsdGeom.Tokens.vertex).Set(Vt.Vec2fArray.FromNumpy(upwards))
    material = _material(stage, f"{path}_material", part, place)
    UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(material)


def _material(stage: Any, path: str, part: Part, place: Path) -> Any:
    Sdf, UsdShade = map(_module, ("Sdf", "UsdShade"))

    types = Sdf.ValueTypeNames
    source = part.material
    material: Any = UsdShade.Material.Define(stage, path)
    surface: Any = UsdShade.Shader.Define(stage, f"{path}/surface")
    surface.CreateIdAttr("UsdPreviewSurface")
    material.CreateSurfaceOutput().ConnectToSource(surface.ConnectableAPI(), "surface")
    coordinates: Any = UsdShade.Shader.Define(stage, f"{path}/coordinates")
    coordinates.CreateIdAttr("UsdPrimvarReader_float2")
    coordinates.CreateInput("varname", types.String).Set("st")
    coordinates.CreateOutput("result", types.Float2)

    def connect(name: str, kind: Any, pixels: np.ndarray, channel: str, space: str) -> Any:
        file = place / f"{Path(path).name}-{name}.png"
        file.write_bytes(png(pixels))
        texture: Any = UsdShade.Shader.Define(stage, f"{path}/{name}")
        texture.CreateIdAttr("UsdUVTexture")
        texture.CreateInput("file", types.Asset).Set(f"./{file.name}")
        texture.CreateInput("sourceColorSpace", types.Token).Set(space)
        for axis in ("wrapS", "wrapT"):
            texture.CreateInput(axis, types.Token).Set("repeat")
        texture.CreateInput("st", types.Float2).ConnectToSource(coordinates.ConnectableAPI(), "result")
        texture.CreateOutput(channel, kind)
        surface.CreateInput(name, kind).ConnectToSource(texture.ConnectableAPI(), channel)
        return texture

    if source.base_colour.ndim == 3:
        connect("diffuseColor", types.Color3f, textures.base_colour(part), "rgb", "sRGB")
    else:
        surface.CreateInput("diffuseColor", types.Color3f).Set(tuple(map(float, source.base_colour)))
    for name, value in (("roughness", source.roughness), ("metallic", source.metallic)):
        if value.ndim:
            connect(name, types.Float, textures.grey(value), "r", "raw")
        else:
            surface.CreateInput(name, types.Float).Set(float(value))
    if (normals := textures.normal_map(part)) is not None:
        texture = connect("normal", types.Normal3f, normals, "rgb", "raw")
        texture.CreateInput("scale", types.Float4).Set((2.0, 2.0, 2.0, 2.0))
        texture.CreateInput("bias", types.Float4).Set((-1.0, -1.0, -1.0, -1.0))
    surface.CreateInput("ior", types.Float).Set(max(source.ior, 1.0))
    return material
