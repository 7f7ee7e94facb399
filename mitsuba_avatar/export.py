"""Take a fitted avatar to other programs: `python -m mitsuba_avatar.export RUN [--format glb usdskel obj ply usd textures]`.

A GLB, or a USD file with UsdSkel, holds skeleton, skin, shapes of the face, one texture and the motion of a driving capture; OBJ, PLY
and a USD point cache hold the posed surfaces frame by frame; textures come as EXR (linear) and PNG (sRGB). What a format cannot hold is
measured and printed; docs/export.md has more.
"""

import io
import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
import tyro

from mitsuba_avatar.command_line import interruptible
from mitsuba_avatar.files import atomic_path, check_writable
from mitsuba_avatar.rendering import backend

if TYPE_CHECKING:  # these load torch and Dr.Jit, which must wait for the variant
    from mitsuba_avatar.exporting.character import Character, Motion
    from mitsuba_avatar.loaded_run import LoadedRun


@dataclass(frozen=True)
class ExportCommand:
    """Write a run's avatar in formats of other programs."""

    run: Annotated[Path, tyro.conf.Positional]  # run folder that fit wrote
    format: tuple[Literal["glb", "usdskel", "obj", "ply", "usd", "textures"], ...] = ("glb", "textures")  # any of them
    split: Literal["test", "train", "stress"] = "test"  # frames that drive the avatar
    frames: int = 0  # how many, from the split's first on; 0: all
    influences: Literal[4, 8] = 4  # glb, usdskel: joints per vertex
    pose_shapes: int = 16  # glb, usdskel: principal shapes of the decoder's surfaces; 0: the skeleton alone moves
    face_shapes: Literal["auto", "actions", "principal", "none"] = "auto"  # glb, usdskel: facial actions, or principal shapes
    texture: Literal["radiance", "albedo"] = "radiance"  # of all but ply: as captured, or to be lit
    captured_light: str = "auto"  # divided out for albedo: auto (the capture's own), uniform, or a scene
    validate: bool = False  # glb: also run the Khronos validator (node and the npm package gltf-validator)
    capture: str = ""  # driving capture of the same rig, a folder or FORMAT:DIR; default: the run's
    checkpoint: str = "last"  # best or last
    out: str = ""  # folder; default: RUN/export
    variant: str = "auto"  # Mitsuba variant


@interruptible("export", kept="finished files are whole and kept. Give the same command again to write all of them.")
def main(arguments: list[str] | None = None) -> int:
    """Run the command; returns the exit status."""
    command = tyro.cli(ExportCommand, args=arguments)
    try:
        if command.frames < 0:
            raise ValueError(f"expected --frames of at least 1, or 0 for all; got {command.frames}.")
        backend.select_variant(command.variant)
        output = _export(command)
    except (ValueError, OSError, ModuleNotFoundError, backend.BackendError) as error:
        sys.stderr.write(f"export: {error}\n")
        return 2
    sys.stdout.write(f"{output}\n")
    return 0


def _export(command: ExportCommand) -> Path:
    # Imported after the variant is set, because these modules load torch and Dr.Jit.
    from mitsuba_avatar.exporting.character import CharacterSettings, make_character, play
    from mitsuba_avatar.exporting.usd import load_usd
    from mitsuba_avatar.loaded_run import LoadedRun

    if set(command.format) & {"usd", "usdskel"}:
        load_usd()  # a missing package is told before the long work, not after it
    settings = CharacterSettings(command.influences, command.pose_shapes, command.face_shapes)
    loaded = LoadedRun.open(command.run, command.capture, command.checkpoint)
    folder = Path(command.out) if command.out else loaded.run.path / "export"
    check_writable(folder)
    frames = loaded.capture.frame_indices(command.split)
    frames = frames[: command.frames] if command.frames else frames
    texture = _write_textures(command, loaded, folder) if set(command.format) != {"ply"} else None
    motion: Motion
    if set(command.format) & {"glb", "usdskel"}:
        character = make_character(loaded.avatar, loaded.run.rig, loaded.capture, frames, settings)
        _print_costs(character.costs_mm)
        if "glb" in command.format:
            _write_glb(command, folder / "avatar.glb", character, texture)
        if "usdskel" in command.format:
            _write_usd_character(command, folder / "avatar_skeleton.usdc", character)
        motion = character.motion
    elif set(command.format) & {"obj", "ply", "usd"}:
        motion = play(loaded.avatar, loaded.capture, frames)
    else:
        return folder
    _write_sequences(command, loaded, folder, motion, texture, [loaded.capture.frames[frame].number for frame in frames])
    return folder


def _write_textures(command: ExportCommand, loaded: "LoadedRun", folder: Path) -> np.ndarray:
    """Radiance and, where it is wanted, albedo as EXR and PNG; returns the chosen one as bytes [T, T, 3]."""
    from mitsuba_avatar.progress import progress_bar
    from mitsuba_avatar.reporting.exr import write_exr
    from mitsuba_avatar.reporting.playback import Playback
    from mitsuba_avatar.reporting.relighting import CapturedLight, SurfaceRadiance, estimate_albedo
    from mitsuba_avatar.reporting.view_transform import ViewTransform, write_png

    trained = loaded.trained_capture()
    shown = SurfaceRadiance(Playback(loaded.avatar, trained, loaded.occlusion()), loaded.run.rig.topology)
    maps = {"radiance": shown.mean()} if command.texture == "radiance" or "textures" in command.format else {}
    if command.texture == "albedo" or "textures" in command.format:
        with progress_bar("albedo", len(shown.frames)) as bar:
            maps["albedo"] = estimate_albedo(shown, CapturedLight.of(trained, command.captured_light), bar.update)
    pictures = {}
    for name, values in maps.items():
        linear = np.ascontiguousarray(values.permute(1, 2, 0).numpy())
        transform = ViewTransform()
        pictures[name] = transform.apply(linear, np.ones(linear.shape[:2], np.float32))
        write_png(folder / "textures" / f"{name}.png", pictures[name], transform)
        write_exr(folder / "textures" / f"{name}.exr", {"colour": linear}, comments="row 0 at v = 1")
    return pictures[command.texture]


def _write_glb(command: ExportCommand, path: Path, character: "Character", texture: np.ndarray | None) -> None:
    """The GLB, read back and measured; figures go to the terminal and into a file beside it."""
    from PIL import Image

    from mitsuba_avatar.exporting.checking import check_reread, posing_error_mm, validate_gltf
    from mitsuba_avatar.exporting.glb import write_glb

    data = io.BytesIO()
    Image.fromarray(texture).save(data, format="png")
    write_glb(path, character, data.getvalue(), is_lit=command.texture == "albedo")
    check_reread(path, character)
    facts = _played(character, "all of it, played by glTF's rules", posing_error_mm(path, character))
    if command.validate:
        report = validate_gltf(path)
        facts["validator"] = vars(report)
        sys.stdout.write(f"Khronos validator: {report.errors} errors, {report.warnings} warnings\n")
        for message in report.messages[:10]:
            sys.stdout.write(f"  {message}\n")
    _write_facts(path.with_suffix(".json"), facts)


def _write_usd_character(command: ExportCommand, path: Path, character: "Character") -> None:
    """The character for USD, posed by USD itself and measured; figures go to the terminal and into a file beside it."""
    from mitsuba_avatar.exporting.usd import usd_posing_error_mm, write_usd_character

    write_usd_character(path, character, f"textures/{command.texture}.png", is_lit=command.texture == "albedo")
    _write_facts(path.with_suffix(".json"), _played(character, "all of it, posed by USD", usd_posing_error_mm(path, character)))


def _played(character: "Character", name: str, errors_mm: np.ndarray) -> dict[str, object]:
    """Print how far a written file is from the avatar; returns what stands in the file beside it."""
    cost = {name: (float(np.sqrt(np.mean(np.square(errors_mm, dtype=np.float64)))), float(errors_mm.max()))}
    _print_costs(cost)
    return {"costs_mm": character.costs_mm | cost, "shapes": character.shapes.names, "frames": len(character.motion.root)}


def _print_costs(costs_mm: dict[str, tuple[float, float]]) -> None:
    for name, (typical, largest) in costs_mm.items():
        sys.stdout.write(f"{name}: {typical:.2f} mm root mean square, {largest:.1f} mm at most\n")


def _write_facts(path: Path, facts: dict[str, object]) -> None:
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(facts, indent=1) + "\n", encoding="utf-8")


def _write_sequences(
    command: ExportCommand, loaded: "LoadedRun", folder: Path, motion: "Motion", texture: np.ndarray | None, numbers: list[int]
) -> None:
    """Posed surfaces, frame by frame."""
    from mitsuba_avatar.exporting.sequences import ObjSequence, write_ply
    from mitsuba_avatar.exporting.usd import write_usd_cache
    from mitsuba_avatar.progress import progress_bar

    topology = loaded.run.rig.topology
    if "usd" in command.format:
        picture, is_lit = f"textures/{command.texture}.png", command.texture == "albedo"
        write_usd_cache(folder / "avatar.usdc", motion.vertices, topology, motion.fps, picture, is_lit)
    obj = ObjSequence(folder / "obj", topology, texture) if "obj" in command.format and texture is not None else None
    if obj is None and "ply" not in command.format:
        return
    with progress_bar("writing", len(numbers)) as bar:
        for done, (number, vertices) in enumerate(zip(numbers, motion.vertices, strict=True)):
            if obj is not None:
                obj.write(f"{number:06d}.obj", vertices)
            if "ply" in command.format:
                write_ply(folder / "ply" / f"{number:06d}.ply", vertices, topology)
            bar.update(done + 1)


if __name__ == "__main__":
    sys.exit(main())
