"""The scene of a rollout as an HTML page of its own."""

import threading

from pemviz.panel.scene import FIRST_VIEW_FOV, FIRST_VIEW_POSITION, FIRST_VIEW_TARGET, Scene
from pemviz.panel.server import guarded_server
from pemviz.panel.views.rollout import Track

REST_S = 1.0
_ONE_PAGE_AT_A_TIME = threading.Lock()


def scene_html(chosen: Track) -> str:
    """The scene as an HTML page that plays without a server, and rests a moment at its end."""
    with _ONE_PAGE_AT_A_TIME:
        return _scene_html(chosen)


def _scene_html(chosen: Track) -> str:
    server = guarded_server(host="127.0.0.1", port=0, closed=True)
    try:
        server.initial_camera.position = FIRST_VIEW_POSITION
        server.initial_camera.look_at = FIRST_VIEW_TARGET
        server.initial_camera.fov = FIRST_VIEW_FOV
        scene = Scene(server.scene)
        scene.show(chosen)
        scene.at(0)
        serializer = server.get_scene_serializer()
        for step in range(1, chosen.states):
            serializer.insert_sleep(chosen.dt_s)
            scene.at(step)
        serializer.insert_sleep(REST_S)
        return serializer.as_html()
    finally:
        server.stop()
