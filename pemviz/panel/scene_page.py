"""The scene of a rollout as an HTML page of its own."""

import threading
from collections.abc import Callable

import viser

from pemviz.panel.road_scene import ROAD_VIEW_POSITION, ROAD_VIEW_TARGET, RoadScene
from pemviz.panel.scene import FIRST_VIEW_FOV, FIRST_VIEW_POSITION, FIRST_VIEW_TARGET, Scene, lights
from pemviz.panel.server import guarded_server
from pemviz.panel.views.road_rollout import RoadTrack
from pemviz.panel.views.rollout import Track

Shown = Track | RoadTrack
REST_S = 1.0
_ONE_PAGE_AT_A_TIME = threading.Lock()


def scene_html(chosen: Shown) -> str:
    """The scene as an HTML page that plays without a server, and rests a moment at its end."""
    with _ONE_PAGE_AT_A_TIME:
        return _scene_html(chosen)


def _scene_html(chosen: Shown) -> str:
    server = guarded_server(host="127.0.0.1", port=0, closed=True)
    try:
        on_roads = isinstance(chosen, RoadTrack)
        server.initial_camera.position = ROAD_VIEW_POSITION if on_roads else FIRST_VIEW_POSITION
        server.initial_camera.look_at = ROAD_VIEW_TARGET if on_roads else FIRST_VIEW_TARGET
        server.initial_camera.fov = FIRST_VIEW_FOV
        at = drawn_in(server.scene, chosen)
        at(0)
        serializer = server.get_scene_serializer()
        for step in range(1, chosen.states):
            serializer.insert_sleep(chosen.dt_s)
            at(step)
        serializer.insert_sleep(REST_S)
        return serializer.as_html()
    finally:
        server.stop()


def drawn_in(api: viser.SceneApi, chosen: Shown) -> Callable[[int], None]:
    """Draw a rollout with a scene API; what it gives moves everything to a step."""
    if isinstance(chosen, RoadTrack):
        roads = RoadScene(api)
        lights(api)
        roads.show(chosen)
        return roads.at
    scene = Scene(api)
    scene.show(chosen)
    return scene.at
