"""Export of results: a scene folder that plain Mitsuba loads, files for other programs, and the recovered maps alone.

Scenes for Mitsuba: textures are EXR files with every recovered bit, meshes PLY, grids `.vol`. Poses become `to_world`. The integrator
is `path`, or `volpath` with media, with the problem's `max_depth`. `maps/`, `parameters.json` and `parameters.csv` have the values alone.

Files for other programs:

| item | in Mitsuba | in the files |
|---|---|---|
| axes | the world of the scene, right-handed | unchanged: glTF calls y up; Blender's importer turns it to z |
| texture coordinates | v downwards | downwards in glTF; upwards in OBJ and PLY |
| roughness | perceptual, α = roughness² | the same in all |
| normal map | second tangent n × ∂p/∂u | green points up; flipped where the texture lies mirrored on the mesh |
| base colour | linear, every bit | 8 bits, sRGB; values outside [0, 1] are clipped |
| no specular (`diffuse`) | | `KHR_materials_specular` 0 in glTF, `illum 1` in MTL |
| diffuse lobe | Burley's (`principled`) | Lambert's in glTF viewers and Blender, which adds multiple reflections in rough metal |
"""
