import html
import re
from types import SimpleNamespace

import numpy as np
import pytest

from sim_bridge.hockey import table
from sim_bridge.hockey.scene import START_JOINTS, AirHockeyScene
from sim_bridge.report import video
from sim_bridge.report.overlay import Overlay
from sim_bridge.report.page import number, write_page
from sim_bridge.report.stage import AirHockeyStage, PushingStage
from sim_bridge.report.view import Frame, ModelState, replay_page
from sim_bridge.scene import Scene
from vpsto_ros.robot.iiwa import iiwa14
from vpsto_ros.robot.kinematics import fr3_pusher

STAGE = PushingStage(Scene())


def test_a_frame_puts_robot_object_and_target_where_they_belong():
    robot, state = fr3_pusher(), ModelState(STAGE)
    joints = Scene().joints() + 0.1
    state.pose(Frame(joints, np.array([0.5, 0.1, 0.7]), np.array([0.55, -0.1])))
    assert state.data.site("tool_tip").xpos == pytest.approx(robot.forward(joints)[0], abs=1e-9)
    assert state.data.body("object").xpos[:2] == pytest.approx([0.5, 0.1])
    assert state.data.body("object").xquat == pytest.approx([np.cos(0.35), 0.0, 0.0, np.sin(0.35)])
    assert state.data.body("goal").xpos[:2] == pytest.approx([0.55, -0.1])


@pytest.mark.parametrize("target", [None, np.array([np.nan, np.nan])])
def test_without_a_target_none_is_seen(target):
    state = ModelState(STAGE)
    state.pose(Frame(Scene().joints(), target=target))
    assert state.data.body("goal").xpos[2] < -0.1


def test_the_replay_is_one_page_that_loads_nothing():
    joints = Scene().joints()
    path = np.linspace([0.4, 0.0, 0.01], [0.5, 0.1, 0.01], 30)
    plan = Overlay("planned_tool_path", np.stack([path[:-1], path[1:]], axis=1), (0.1, 0.4, 0.9), 0.003)
    cloud = Overlay("object_belief", path, (0.9, 0.8, 0.2), 0.006)
    overlays = [(plan, cloud)[: i % 3] for i in range(5)]
    poses = [np.array([0.5, 0.01 * i, 0.0]) for i in range(5)]
    target = np.array([0.6, 0.0])
    frames = [Frame(joints + 0.01 * i, poses[i], target, overlays[i]) for i in range(5)]
    page = replay_page(STAGE, frames, 20.0)
    assert "__VISER_EMBED_DATA__" in page
    assert not re.search(r"<(script|link|img)[^>]*(src|href)=\"(?!data:)", page)


def test_a_report_embeds_pictures_and_replay_and_escapes_text(tmp_path):
    picture = tmp_path / "chart.png"
    picture.write_bytes(b"\x89PNG fake")
    replay = '<html><script>var a = "b" < 3 && 1;</script></html>'
    out = tmp_path / "report.html"
    write_page(
        out,
        "Box & co",
        "3 < 4",
        True,
        [("Table", [["a", "b"], ["x", "<1>"]])],
        [(picture, "a chart")],
        replay,
    )
    text = out.read_text()
    assert "Box &amp; co" in text and "3 &lt; 4" in text and "&lt;1&gt;" in text
    assert 'src="data:image/png;base64,' in text
    frame = re.search(r'srcdoc="([^"]*)"', text)
    assert frame and html.unescape(frame.group(1)) == replay


def test_numbers_for_people():
    assert number(0.01234, 1e3, "mm", 1) == "12.3 mm"
    assert number(float("nan"), 1.0, "s", 1) == "never"


def test_a_machine_without_opengl_gets_advice_instead_of_a_video(tmp_path, monkeypatch):
    class Pool:
        def __init__(self, *_args, **_options):
            pass

        def __enter__(self):
            return self

        def __exit__(self, *_):
            return False

        def submit(self, *_):
            def result():
                raise AttributeError("'NoneType' object has no attribute 'eglQueryString'")

            return SimpleNamespace(result=result)

    monkeypatch.setattr(video.concurrent.futures, "ProcessPoolExecutor", Pool)
    note = video.write_video(tmp_path / "video.mp4", STAGE, [], 20.0)
    assert "apt install libegl1" in note and "eglQueryString" in note
    assert not (tmp_path / "video.mp4").exists()


def test_a_frame_of_air_hockey_puts_puck_and_hanging_mallet_where_they_belong():
    state, joints = ModelState(AirHockeyStage(AirHockeyScene())), np.array(START_JOINTS) + 0.05
    state.pose(Frame(joints, np.array([1.2, -0.1, 0.7])))
    assert state.data.body("puck").xpos[:2] == pytest.approx([1.2, -0.1])
    joint = iiwa14().forward(joints)[0]
    geom = state.data.geom("mallet")
    assert geom.xpos == pytest.approx(joint - [0.0, 0.0, table.MALLET_OFFSET], abs=1e-6)
    assert geom.xmat.reshape(3, 3)[2, 2] == pytest.approx(-1.0, abs=1e-9)


def test_a_replay_shows_texts_that_change():
    joints, stage = np.array(START_JOINTS), AirHockeyStage(AirHockeyScene())
    texts = [Overlay("shot", np.ones((1, 3)), (1.0, 1.0, 1.0), 0.05, text) for text in ("61 %", "62 %")]
    frames = [Frame(joints, overlays=(text,)) for text in texts] + [Frame(joints)]
    assert "__VISER_EMBED_DATA__" in replay_page(stage, frames, 20.0)


def test_texts_of_nodes_are_written_into_the_picture():
    blank = np.full((video.HEIGHT, video.WIDTH, 3), 255, dtype=np.uint8)
    said = Overlay("shot", np.zeros((1, 3)), (1.0, 1.0, 1.0), 0.05, "97 % to score")
    frame = Frame(np.zeros(7), overlays=(said,))
    written = video._with_texts(blank, frame)
    dark = np.argwhere(written.min(axis=2) < 100)
    assert len(dark) > 200 and dark[:, 0].min() > 0.8 * video.HEIGHT
    assert video._with_texts(blank, Frame(np.zeros(7))) is blank
