"""Splats as an independent viewer draws them: Spark (MIT) on three.js, in headless Chromium, WebGL by the processor.

Where the packages are is in FIELDFUSE_NODE_MODULES: `npm install three @sparkjsdev/spark`, then the folder node_modules.
"""

from __future__ import annotations

import base64
import json
import os
import threading
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import cv2
import numpy as np
import pytest

from fieldfuse.camera import Array, Intrinsics, opengl_from_world
from tests.evaluation.driven import driven, until

PAGE = """<!doctype html><style>body{{margin:0}}canvas{{display:block}}</style>
<script type="importmap">{{"imports":{{"three":"/modules/three/build/three.module.js",
"three/addons/":"/modules/three/examples/jsm/","@sparkjsdev/spark":"/modules/@sparkjsdev/spark/dist/spark.module.js"}}}}</script>
<script type="module">
import * as THREE from "three";
import {{SparkRenderer, SplatMesh}} from "@sparkjsdev/spark";
const {{width, height, projection, pose, background}} = {scene};
const renderer = new THREE.WebGLRenderer({{antialias: false, preserveDrawingBuffer: true}});
renderer.setPixelRatio(1);
renderer.setSize(width, height);
document.body.append(renderer.domElement);
const scene = new THREE.Scene();
scene.background = new THREE.Color().setRGB(...background, THREE.SRGBColorSpace);
// For splats that are trained as Kerbl et al. do, without opacities that make up for the blur (Spark's default).
scene.add(new SparkRenderer({{renderer, preBlurAmount: 0.3, blurAmount: 0.0}}));
const camera = new THREE.PerspectiveCamera();
camera.matrixAutoUpdate = false;
camera.matrix.fromArray(pose);
camera.matrixWorld.fromArray(pose);
camera.projectionMatrix.fromArray(projection);
camera.projectionMatrixInverse.copy(camera.projectionMatrix).invert();
const splats = new SplatMesh({{url: "/{name}"}});
await splats.initialized;
scene.add(splats);
let frames = 0;
renderer.setAnimationLoop(() => {{
  renderer.render(scene, camera);
  window.frames_drawn = ++frames;
}});
window.shot = () => renderer.domElement.toDataURL("image/png");
</script>"""


class _Files(SimpleHTTPRequestHandler):
    def translate_path(self, path: str) -> str:
        return str(Path(modules()) / path[len("/modules/") :]) if path.startswith("/modules/") else super().translate_path(path)

    def log_message(self, format: str, *args: object) -> None:
        pass


def modules() -> str:
    """The folder of npm's packages, or skip with the reason."""
    folder = os.environ.get("FIELDFUSE_NODE_MODULES", "")
    if not (Path(folder) / "@sparkjsdev/spark").is_dir() or not folder:
        pytest.skip("Spark is not installed: npm install three @sparkjsdev/spark, and FIELDFUSE_NODE_MODULES=…/node_modules")
    return folder


def spark(path: Path, intrinsics: Intrinsics, world_from_camera: Array, background: tuple[float, float, float], scratch: Path) -> Array:
    """(H, W, 3) uint8: a splat file as a pinhole camera sees it. `scratch`: a folder for the browser's files."""
    modules()
    c, near, far = intrinsics, 0.01, 1e4
    projection = np.zeros((4, 4))
    projection[0, 0], projection[1, 1] = 2 * c.fx / c.width, 2 * c.fy / c.height
    projection[0, 2], projection[1, 2] = 1 - 2 * c.cx / c.width, 2 * c.cy / c.height - 1
    projection[2, 2:] = -(far + near) / (far - near), -2 * far * near / (far - near)
    projection[3, 2] = -1
    scene = {
        "width": c.width,
        "height": c.height,
        "projection": projection.T.ravel().tolist(),
        "pose": opengl_from_world(world_from_camera).T.ravel().tolist(),
        "background": list(background),
    }
    (path.parent / "index.html").write_text(PAGE.format(scene=json.dumps(scene), name=path.name))
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(_Files, directory=str(path.parent)))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        size = (max(500, c.width), c.height + 200)
        with driven(f"http://127.0.0.1:{server.server_address[1]}/index.html", scratch, size) as page:
            try:
                until(lambda: page.run("window.frames_drawn > 0"))
                last = None
                for _ in range(40):  # splats are sorted in a thread of its own, so that the first frames lack some
                    seen = page.run("window.frames_drawn")
                    until(lambda seen=seen: page.run("window.frames_drawn") > seen + 1)
                    shot = page.run("window.shot()")
                    if shot == last:
                        break
                    last = shot
            except AssertionError:
                raise AssertionError(f"Spark drew nothing: {page.errors}") from None
        png = np.frombuffer(base64.b64decode(shot.split(",")[1]), np.uint8)
        return np.asarray(cv2.cvtColor(cv2.imdecode(png, cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB))
    finally:
        server.shutdown()
