"""The viewer's server: what windows are sent and when, what widgets do, and the port. One test drives a real browser, if there is one."""

import shutil
import socket
import threading
import time
from dataclasses import dataclass, field
from types import SimpleNamespace

import numpy as np
import pytest

viser = pytest.importorskip("viser")

from mitsuba_avatar.viewing import browser  # noqa: E402 - only where viser is
from mitsuba_avatar.viewing.browser import BrowserViewer, check_port  # noqa: E402

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of viser's web server


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


@pytest.fixture
def viewer(session):
    viewer = BrowserViewer(session, "127.0.0.1", free_port(), 96, "a run")
    yield viewer
    viewer.server.stop()


@dataclass
class Window:
    """Stands for a connected browser: a camera, and a scene that keeps what it is sent."""

    camera: SimpleNamespace
    pictures: list[np.ndarray] = field(default_factory=list)

    @property
    def scene(self):
        return SimpleNamespace(set_background_image=lambda image, **options: self.pictures.append(image))


def window(viewer: BrowserViewer) -> Window:
    centre, target = viewer.session.first_view()
    forward = (target - centre) / np.linalg.norm(target - centre)
    right = np.cross(forward, [0, 0, 1])
    right /= np.linalg.norm(right)
    from scipy.spatial.transform import Rotation

    xyzw = Rotation.from_matrix(np.stack([right, np.cross(forward, right), forward], axis=1)).as_quat()
    return Window(SimpleNamespace(position=centre, wxyz=np.roll(xyzw, 1), fov=0.6, aspect=1.0, image_height=600, image_width=600))


def changed_by_user(handle, value) -> None:
    """What viser does when a browser sends a new value."""
    handle._impl.value = value
    for callback in handle._impl.update_cb:
        callback(viser.GuiEvent(client=object(), client_id=0, target=handle))


def test_a_window_gets_a_coarse_picture_then_a_fine_one_then_peace(viewer, monkeypatch):
    monkeypatch.setattr(browser, "STILL_AFTER", 0.05)
    one = window(viewer)
    monkeypatch.setattr(viewer.server, "get_clients", lambda: {0: one})
    assert viewer._draw_windows()
    assert not viewer._draw_windows(), "not still for long enough"
    time.sleep(0.06)
    assert viewer._draw_windows()
    assert not viewer._draw_windows() and len(one.pictures) == 2
    assert one.pictures[0].shape == (96, 96, 3) and np.ptp(one.pictures[1]) > 40
    one.camera.position = one.camera.position + np.array([0.3, 0, 0])
    assert viewer._draw_windows() and not np.array_equal(one.pictures[2], one.pictures[1])


def test_a_window_that_has_not_said_where_it_looks_from_waits(viewer, monkeypatch):
    one = window(viewer)
    one.camera.image_height = 0
    monkeypatch.setattr(viewer.server, "get_clients", lambda: {0: one})
    assert not viewer._draw_windows() and not one.pictures


def test_sliders_change_the_session_and_follow_it(viewer):
    session = viewer.session
    elbow = session.viewed.rig.dofs.names.index("elbow_flexion")
    changed_by_user(viewer._angles[elbow], 45.0)
    assert session.state.theta[elbow] == pytest.approx(np.radians(45))
    kind, index, slider = next(entry for entry in viewer._shifts if entry[0] == "latent_shift")
    changed_by_user(slider, 1.5)
    assert session.state.latent_shift[index] == 1.5
    session.set_frame(1)
    version = session.version
    viewer._show_state()
    assert session.version == version, "sliders set by the viewer do not come back as changes"
    assert viewer._frame.value == 1
    assert viewer._angles[elbow].value == pytest.approx(np.degrees(session.state.theta[elbow]), abs=0.06)


def test_playing_moves_the_timeline(viewer, monkeypatch):
    viewer._play(True)
    now = time.monotonic()
    monkeypatch.setattr(browser.time, "monotonic", lambda: now + 1.05 / viewer.session.viewed.timeline.fps)
    viewer._advance()
    assert viewer.session.state.frame == 1
    viewer._play(False)
    viewer.session.set_frame(0)
    viewer._advance()
    assert viewer.session.state.frame == 0


def test_a_port_in_use_is_refused_with_its_name(session):
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        with pytest.raises(OSError, match=rf"expected to listen on 127\.0\.0\.1:{port}; got: .*in use.*--port"):
            check_port("127.0.0.1", port)
        with pytest.raises(OSError, match="expected to listen"):
            BrowserViewer(session, "127.0.0.1", port, 96, "a run")


def test_the_port_is_free_again_after_the_end(session):
    port = free_port()
    viewer = BrowserViewer(session, "127.0.0.1", port, 96, "a run")
    looks = iter([False, False, True])
    viewer.run(lambda: next(looks))
    check_port("127.0.0.1", port)


@pytest.mark.slow
def test_a_real_browser_shows_the_person(session, tmp_path):
    """Headless Chromium: the page shows the picture; a click on the map loads a pose."""
    playwright = pytest.importorskip("playwright.sync_api")
    chromium = next((path for name in ("chromium", "chromium-browser", "google-chrome") if (path := shutil.which(name))), None)
    if chromium is None:
        pytest.skip("no Chromium on this machine")
    port, is_over = free_port(), threading.Event()
    found: dict[str, object] = {}

    def look() -> None:
        try:
            with playwright.sync_playwright() as driver:
                page = driver.chromium.launch(
                    executable_path=chromium, args=["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
                ).new_page(viewport={"width": 900, "height": 600})
                page.goto(f"http://127.0.0.1:{port}")
                page.get_by_text("pictures/s").wait_for(timeout=60000)
                time.sleep(3)
                page.screenshot(path=tmp_path / "page.png")
                found["tabs"] = [tab.inner_text() for tab in page.get_by_role("tab").all()]
                side = round(0.34 * 600)
                x, y = session.pose_map.points["training"][0] * side
                page.mouse.click(float(x), 600 - side + float(y))
                time.sleep(2)
        finally:
            is_over.set()

    before = session.state.theta
    viewer = BrowserViewer(session, "127.0.0.1", port, 192, "a run")
    thread = threading.Thread(target=look)
    thread.start()
    viewer.run(is_over.is_set)
    thread.join()
    assert found["tabs"] == ["Show", "Pose", "Face, z"]
    from mitsuba_avatar.captures.images import read_image

    page = read_image(tmp_path / "page.png").astype(float)
    canvas = page[:350, 250:550]
    assert np.ptp(canvas.reshape(-1, 3), axis=0).max() > 60, "the person is on the page"
    assert not np.array_equal(before, session.state.theta), "the click loaded a pose"
