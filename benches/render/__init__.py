"""A renderer of synthetic scenes with exact depth: ray casting over procedural meshes and textures, then structure from motion.

Everything static is one triangle mesh, and `truth/scene.ply` is exactly the mesh that is rendered. Metres, z up. Cameras as in COLMAP:
x right, y down, z forward, centre of the first pixel at (0.5, 0.5). The same scene, seed and size give the same bytes.

    scenes/      one file per scene: its layout, and its own views
    noise, textures, outdoor_shading, indoor_shading    colour of a point of a surface
    shapes, terrain, buildings, plants, furniture, bust, outdoors    the mesh
    flights      poses outdoors; those indoors are in the scenes' files
    camera, rays, frame    rays, hits, a picture and its depth
    depth_file, colmap_model, ply    files
    pictures, mapping, checks, describe    the steps that make a set (see __main__)
"""
