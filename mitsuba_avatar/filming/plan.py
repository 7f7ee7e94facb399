"""What filming will cost, and how it is shared out: a capture's images in one order, cut into shards that any process may film.

The cost is estimated from figures measured on two cores with Mitsuba's llvm variant; other machines differ, shares do not.
"""

from dataclasses import dataclass

from mitsuba_avatar.command_line import parse_shard
from mitsuba_avatar.filming.settings import StudioSettings

SHARE_OF_PERSON = 0.17  # of an image's pixels: only these are traced
PIXELS_OF_OUTLINE = 16  # traced besides, per row and column: a triangle's box is a few pixels larger than what is seen of it
PATHS_PER_SECOND = 4.5e6  # camera rays times paths that go on from them
SECONDS_PER_IMAGE = 0.012  # whatever its size: preparing and writing it
SECONDS_PER_PIXEL = 1.5e-7  # encoding
SECONDS_PER_FRAME = 0.10  # surfaces and their occlusion
SECONDS_PER_TEXEL = 1.5e-5  # of a texture's: painting all layers, in every process
SECONDS_PER_PLANNED_FRAME = 4.5e-4  # choreography and feet on the floor of the whole capture, in every process
SIMULATION_SECONDS = 0.18  # a frame of simulated cloth at ten frames a second, with its share of settling
BYTES_PER_PIXEL, BYTES_OF_OUTLINE = 0.15, 27  # PNG of image and mask; the second per row and column
BYTES_PER_FRAME = 430_000  # arrays and truth
HOUR = 3600.0
LONG = 48 * HOUR  # seconds beyond which filming is refused without a shard


@dataclass(frozen=True)
class FilmingPlan:
    """Numbers of a capture to be, and an estimate of its cost on two cores.

    Attributes:
        preparation: seconds in which every process paints the person and plans the motion of all frames, before its first image.
        seconds: of one process that films everything, preparation and all.
        bytes: on disk.
    """

    frames: int
    cameras: int
    width: int
    height: int
    preparation: float
    seconds: float
    bytes: float

    @property
    def images(self) -> int:
        """How many."""
        return self.frames * self.cameras

    def text(self) -> str:
        """The plan in words: what, how long and how large, and for a long one how to share it out."""
        hours = self.seconds / HOUR
        duration = f"{self.seconds / 60:.1f} minutes" if hours < 1 else f"{hours:.1f} hours" if hours < 48 else f"{hours / 24:,.0f} days"
        shards = self.suggested_shards()
        advice = (
            f"a shard i/n films n-th parts of the images: --shard 0/{shards} takes about an hour, {self.preparation:.0f} seconds of it\n"
            "preparation; the garment of frames before it in its segment is simulated first, if no other shard has done so\n"
            if shards > 1
            else ""
        )
        return (
            f"{self.frames:,} frames from {self.cameras} cameras of {self.width} x {self.height} pixels: {self.images:,} images\n"
            f"about {duration} on two cores, {self.bytes / 1e9:,.2f} GB\n"
            f"{advice}"
        )

    def suggested_shards(self) -> int:
        """Shards of about an hour each, preparation included."""
        return max(1, round((self.seconds - self.preparation) / (HOUR - min(self.preparation, 0.5 * HOUR))))

    def seconds_of_shard(self, count: int) -> float:
        """What one of `count` equal shards takes."""
        return self.preparation + (self.seconds - self.preparation) / count


@dataclass(frozen=True)
class Shard:
    """Part `index` of `count` of a capture's images."""

    index: int = 0
    count: int = 1

    @classmethod
    def parse(cls, text: str) -> "Shard":
        """Read "i/n"; empty text is the whole.

        Raises:
            ValueError: for anything else, or i outside 0..n-1.
        """
        return cls(*parse_shard(text))

    def images(self, num_frames: int, num_cameras: int) -> dict[int, list[int]]:
        """Frame -> indices of the cameras whose image of it belongs to this shard. Consecutive frames, so that few segments are needed."""
        total = num_frames * num_cameras
        chosen: dict[int, list[int]] = {}
        for place in range(self.index * total // self.count, (self.index + 1) * total // self.count):
            chosen.setdefault(place // num_cameras, []).append(place % num_cameras)
        return chosen


def plan_filming(settings: StudioSettings) -> FilmingPlan:
    """The plan of a capture."""
    motion, cameras, light = settings.motion, settings.cameras, settings.light
    frames = motion.train_frames + motion.validation_frames + motion.test_frames + motion.stress_frames
    count = cameras.train + cameras.held_out
    pixels = cameras.width * cameras.height
    outline = cameras.width + cameras.height
    paths = (pixels * SHARE_OF_PERSON + outline * PIXELS_OF_OUTLINE) * light.samples_per_pixel * light.light_samples
    per_image = paths / PATHS_PER_SECOND + SECONDS_PER_IMAGE + SECONDS_PER_PIXEL * pixels
    per_frame = SECONDS_PER_FRAME + (SIMULATION_SECONDS * 10 / motion.fps if settings.clothing.is_simulated else 0)
    preparation = SECONDS_PER_TEXEL * settings.clothing.texture_size**2 + SECONDS_PER_PLANNED_FRAME * frames
    return FilmingPlan(
        frames=frames,
        cameras=count,
        width=cameras.width,
        height=cameras.height,
        preparation=preparation,
        seconds=preparation + frames * (count * per_image + per_frame),
        bytes=frames * (count * (pixels * BYTES_PER_PIXEL + outline * BYTES_OF_OUTLINE) + BYTES_PER_FRAME),
    )
