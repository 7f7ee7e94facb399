"""The viewing session in a browser, by viser: widgets that call the session, pictures behind the 3D scene's camera.

Viser's threads only change the session's state; one thread, that of `run`, draws. While anything moves it draws coarsely, and finely once
all has been still for a moment.
"""

import socket
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import viser

from mitsuba_avatar.viewing.painter import MOVING, PARTS, STILL
from mitsuba_avatar.viewing.session import FIRST_FIELD, JPEG_QUALITY, LARGEST_SHIFT, ViewerSession
from mitsuba_avatar.viewing.state import SURFACES
from mitsuba_avatar.viewing.window import camera_of_view, film_of_window, pose_of_view

STILL_AFTER = 0.35  # seconds without a change
STATUS_EVERY = 0.5  # seconds between updates of sliders and figures by the viewer itself
IDLE = 0.02  # seconds that the drawing thread rests where nothing changed


@dataclass
class _Window:
    """What a browser's window was sent last."""

    key: tuple = ()
    drawn_at: float = 0.0
    is_fine: bool = False


class BrowserViewer:
    """Serves a session on a port of this machine.

    Args:
        session: to be shown; all windows share its state, each has its own camera.
        host: address to listen on.
        port: to listen on.
        height: of the pictures in pixels; the width follows the window.
        title: shown in the panel.

    Raises:
        OSError: the port is taken.
    """

    def __init__(self, session: ViewerSession, host: str, port: int, height: int, title: str):
        check_port(host, port)
        self.session, self.height = session, height
        self.server = viser.ViserServer(host, port, label="mitsuba_avatar", verbose=False)
        self.server.gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False, control_layout="collapsible")
        self.server.scene.set_up_direction("+z")
        self._windows: dict[int, _Window] = {}
        self._angles: dict[int, viser.GuiSliderHandle] = {}
        self._face_entries: dict[int, viser.GuiSliderHandle] = {}
        self._shifts: list[tuple[str, int, viser.GuiSliderHandle]] = []
        self._is_playing, self._played_from = False, (0.0, 0)
        self._status_at, self._rates = 0.0, []
        self._add_controls(title)
        self.server.on_client_connect(self._place_camera)
        self.server.scene.on_click()(self._click)

    def run(self, is_over: Callable[[], bool] = lambda: False) -> None:
        """Draw until `is_over` says so; returns at once after an interrupt, too."""
        try:
            while not is_over():
                self._advance()
                if not self._draw_windows():
                    time.sleep(IDLE)
        finally:
            self.server.stop()

    def _draw_windows(self) -> bool:
        """Draw every window that shows something old, or coarse for long enough; tells whether there was one."""
        has_drawn = False
        clients = self.server.get_clients()
        self._windows = {number: self._windows.get(number, _Window()) for number in clients}
        for number, client in clients.items():
            window, camera = self._windows[number], client.camera
            if camera.image_height == 0 or not np.linalg.norm(camera.wxyz) > 0:
                continue  # a window that has not said yet where it looks from
            key = (self.session.version, tuple(camera.position), tuple(camera.wxyz), camera.fov, camera.aspect)
            is_new = key != window.key
            if not is_new and (window.is_fine or time.monotonic() - window.drawn_at < STILL_AFTER):
                continue
            started = time.perf_counter()
            width, height = film_of_window(camera.aspect, self.height)
            pose = pose_of_view(np.asarray(camera.position), np.asarray(camera.wxyz))
            view = camera_of_view(pose, camera.fov, camera.aspect, width, height)
            image = self.session.picture(view, MOVING if is_new else STILL)
            client.scene.set_background_image(image, format="jpeg", jpeg_quality=JPEG_QUALITY)
            window.key, window.drawn_at, window.is_fine = key, time.monotonic(), not is_new
            if is_new:
                self._rates.append(time.perf_counter() - started)
            has_drawn = True
        if has_drawn and time.monotonic() - self._status_at > STATUS_EVERY:
            self._tell_status()
        return has_drawn

    def _advance(self) -> None:
        """Move the timeline on while it plays."""
        if self._is_playing:
            started, first = self._played_from
            fps = self.session.viewed.timeline.fps
            frame = (first + int((time.monotonic() - started) * fps)) % len(self.session.viewed.timeline)
            if frame != self.session.state.frame:
                self.session.set_frame(frame)

    def _tell_status(self) -> None:
        """Figures in the panel, and sliders that follow what changed without them."""
        recent = self._rates[-10:]
        parts = self.session.painter.timings.seconds
        shown = ", ".join(f"{part} {1000 * parts[part]:.0f} ms" for part in PARTS if part in parts)
        self._status.content = f"**{len(recent) / max(sum(recent), 1e-9):.1f} pictures/s**: {shown}"
        self._rates = recent
        self._status_at = time.monotonic()
        self._show_state()

    def _show_state(self) -> None:
        """Set every slider to the state; viser sends only those that differ."""
        state = self.session.state
        with self.server.atomic():
            self._frame.value = state.frame
            for index, slider in self._angles.items():
                slider.value = round(float(np.degrees(state.theta[index])), 1)
            for index, slider in self._face_entries.items():
                slider.value = float(np.clip(state.face[index], 0, 1))
            for kind, index, slider in self._shifts:
                slider.value = getattr(state, kind)[index]

    def _add_controls(self, title: str) -> None:
        gui = self.server.gui
        gui.add_markdown(f"**{title}**")
        self._status = gui.add_markdown("drag: orbit, right button: move, wheel: zoom")
        tabs = gui.add_tab_group()
        with tabs.add_tab("Show"):
            self._add_view_controls()
        with tabs.add_tab("Pose"):
            self._add_pose_controls()
        with tabs.add_tab("Face, z"):
            self._add_face_controls()
            self._add_latent_controls()

    def _add_view_controls(self) -> None:
        gui, session = self.server.gui, self.session
        surface = gui.add_dropdown("surface", SURFACES, initial_value=session.state.surface)
        surface.on_update(lambda event: session.change(lambda state: replace(state, surface=event.target.value)))
        for label, name, hint in (
            ("shadow", "has_shadow", "multiply the texture by the quasi-shadow"),
            ("wireframe", "has_wireframe", "draw the mesh's edges"),
            ("in place", "is_in_place", "keep the root of the first frame"),
            ("map of poses", "has_map", "training and other poses; a click on a point loads it"),
        ):
            box = gui.add_checkbox(label, getattr(session.state, name), hint=hint)
            box.on_update(lambda event, name=name: session.change(lambda state: replace(state, **{name: event.target.value})))
        with gui.add_folder("Timeline"):
            last = len(session.viewed.timeline) - 1
            self._frame = gui.add_slider("frame", 0, max(last, 1), 1, 0, disabled=last == 0)
            self._frame.on_update(self._by_user(lambda event: session.set_frame(int(event.target.value))))
            play = gui.add_checkbox("play", False, disabled=last == 0)
            play.on_update(self._by_user(lambda event: self._play(event.target.value)))

    def _add_pose_controls(self) -> None:
        gui, session = self.server.gui, self.session
        names = session.viewed.rig.dofs.names
        back = gui.add_button("pose of the timeline")
        back.on_click(lambda event: (session.set_frame(session.state.frame), self._show_state()))
        for limb, indices in session.limbs.items():
            with gui.add_folder(limb, expand_by_default=len(session.limbs) == 1):
                for index in indices:
                    low, high = np.degrees(session.angle_limits[index])
                    value = float(np.degrees(session.state.theta[index]))
                    label = names[index].removeprefix("left_").removeprefix("right_").replace("_", " ")
                    slider = gui.add_slider(label, float(np.floor(low)), float(np.ceil(high)), 0.1, round(value, 1), hint=names[index])
                    slider.on_update(self._by_user(lambda event, index=index: self._turn(index, event.target.value)))
                    self._angles[index] = slider

    def _add_face_controls(self) -> None:
        gui, session = self.server.gui, self.session
        for index, name in enumerate(session.viewed.face_names):
            slider = gui.add_slider(name, 0.0, 1.0, 0.01, float(np.clip(session.state.face[index], 0, 1)))
            slider.on_update(
                self._by_user(
                    lambda event, index=index: session.change(lambda state: state.with_face_entry(index, float(event.target.value)))
                )
            )
            self._face_entries[index] = slider
        with gui.add_folder("face: principal directions (standard deviations)"):
            self._add_shifts("face_shift", "face")

    def _add_latent_controls(self) -> None:
        gui, session = self.server.gui, self.session
        choice = gui.add_dropdown("z from", session.imputations, initial_value=session.state.imputation)
        choice.on_update(lambda event: session.change(lambda state: replace(state, imputation=event.target.value)))
        if session.latent_directions is not None:
            with gui.add_folder("z: principal directions (standard deviations)"):
                self._add_shifts("latent_shift", "z")
        reset = gui.add_button("reset face and z")
        reset.on_click(lambda event: (session.reset_shifts(), self._show_state()))

    def _add_shifts(self, kind: str, label: str) -> None:
        change = {"face_shift": "with_face_shift", "latent_shift": "with_latent_shift"}[kind]
        for index in range(len(getattr(self.session.state, kind))):
            slider = self.server.gui.add_slider(f"{label} {index + 1}", -LARGEST_SHIFT, LARGEST_SHIFT, 0.05, 0.0)
            slider.on_update(
                self._by_user(
                    lambda event, index=index: self.session.change(lambda state: getattr(state, change)(index, float(event.target.value)))
                )
            )
            self._shifts.append((kind, index, slider))

    @staticmethod
    def _by_user(action: Callable[[viser.GuiEvent], object]) -> Callable[[viser.GuiEvent], None]:
        """An action for what users change; what the viewer itself sets would come back as an event without a client."""

        def react(event: viser.GuiEvent) -> None:
            if event.client is not None:
                action(event)

        return react

    def _turn(self, index: int, degrees: float) -> None:
        self.session.change(lambda state: state.with_angle(index, float(np.radians(degrees))))

    def _play(self, is_playing: bool) -> None:
        self._played_from = (time.monotonic(), self.session.state.frame)
        self._is_playing = is_playing

    def _click(self, event: viser.SceneClickEvent) -> None:
        width, height = film_of_window(event.client.camera.aspect, self.height)
        x, y = event.screen_pos
        self.session.click(x, y, width, height)

    def _place_camera(self, client: viser.ClientHandle) -> None:
        centre, target = self.session.first_view()
        client.camera.fov = FIRST_FIELD
        client.camera.position, client.camera.look_at = tuple(centre), tuple(target)


def check_port(host: str, port: int) -> None:
    """Check that a port can be listened on: viser would take the next free one, and the user wait at the wrong address.

    Raises:
        OSError: something listens there already, or the address is not this machine's.
    """
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except OSError as error:
            raise OSError(
                f"check_port(): expected to listen on {host}:{port}; got: {error.strerror}. Name another with --port, or end what uses it."
            ) from error
