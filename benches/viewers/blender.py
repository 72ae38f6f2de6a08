"""What Blender makes of GLB files: a line of JSON for each, in the order of the arguments.

    python blender.py FILE... [--picture PICTURE]    # of the first file, by Cycles on the processor

Runs in a Python that has the package `bpy`.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from contextlib import redirect_stdout

import bpy
from mathutils import Vector


def read(path: str) -> dict | list[dict]:
    """Triangles, materials and images; the levels of a file lie in one another and count together."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    try:
        bpy.ops.import_scene.gltf(filepath=path)
    except RuntimeError as error:
        return {"problem": str(error).strip().splitlines()[-1]}
    meshes = [thing.data for thing in bpy.data.objects if thing.type == "MESH"]
    images = [image for image in bpy.data.images if image.source == "FILE"]
    return {
        "triangles": sum(len(polygon.vertices) - 2 for mesh in meshes for polygon in mesh.polygons),
        "materials": len({m.name for mesh in meshes for m in mesh.materials if m is not None}),
        # Whoever asks for the size has the image decoded.
        "images": sum(image.size[0] > 0 for image in images),
    }


def draw(path: str) -> None:
    """A picture of what was read last, from the front and a little from above."""
    scene = bpy.context.scene
    corners = [
        thing.matrix_world @ Vector(corner)
        for thing in scene.objects
        if thing.type == "MESH"
        for corner in thing.bound_box
    ]
    low = Vector(min(c[k] for c in corners) for k in range(3))
    high = Vector(max(c[k] for c in corners) for k in range(3))
    camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    towards = Vector((0.5, -1, 0.35)).normalized()
    distance = 1.1 * (high - low).length / 2 / math.sin(camera.data.angle / 2)
    camera.location = (low + high) / 2 + distance * towards
    camera.rotation_euler = towards.to_track_quat("Z", "Y").to_euler()
    camera.data.clip_end = 10 * distance
    scene.collection.objects.link(camera)
    scene.camera = camera
    sun = bpy.data.objects.new("sun", bpy.data.lights.new("sun", "SUN"))
    sun.data.energy = 2
    sun.rotation_euler = camera.rotation_euler
    scene.collection.objects.link(sun)
    scene.world = bpy.data.worlds.new("grey")
    scene.world.node_tree.nodes["Background"].inputs["Color"].default_value = (0.3, 0.3, 0.3, 1)
    scene.view_settings.view_transform = "Standard"
    scene.render.engine = "CYCLES"
    scene.cycles.samples = 32
    scene.render.resolution_x = scene.render.resolution_y = 512
    scene.render.filepath = path
    bpy.ops.render.render(write_still=True)


def main() -> None:
    """Reads the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("files", nargs="+")
    parser.add_argument("--picture")
    args = parser.parse_args()
    for number, path in enumerate(args.files):
        # What Blender itself has to say is not for the reader of the lines.
        with redirect_stdout(sys.stderr):
            told = read(path)
            if args.picture and number == 0:
                draw(args.picture)
        print(json.dumps(told), flush=True)


if __name__ == "__main__":
    main()
