"""Every setting of the project: one frozen dataclass a section, read from YAML, overridden on the command line, saved with the run.

Values out of range are refused as soon as a section is made, before any long work begins. Reading and writing is in `presets.py`.

Units are SI (metres, radians, seconds) and pixels or texels unless a name says otherwise.
"""

from dataclasses import dataclass, field
from typing import Any

PRECISIONS = ("float32", "mixed", "auto")
_RANGES = {
    "positive": lambda value: value > 0,
    "zero or more": lambda value: value >= 0,
    "between 0 and 1": lambda value: 0 <= value <= 1,
    "odd": lambda value: value > 0 and value % 2 == 1,
    "a power of two": lambda value: value > 0 and value & (value - 1) == 0,
}


def expect(settings: Any, expectation: str, *names: str) -> None:
    """Refuse a value outside its range; a tuple must have entries, each within the range."""
    for name in names:
        value = getattr(settings, name)
        entries = value if isinstance(value, tuple) else (value,)
        if not entries or not all(_RANGES[expectation](entry) for entry in entries):
            raise ValueError(
                f"{type(settings).__name__}(): expected {name} to be {expectation}; got {value}. Change it in the preset or override."
            )


@dataclass(frozen=True)
class CaptureSettings:
    """Which capture to learn from, and which of its images."""

    path: str = ""  # capture folder; empty means the embedded default capture, filmed on first use
    held_out_cameras: tuple[str, ...] = ()  # empty means the capture's own list
    image_scale: float = 1.0  # images and cameras are resized by this factor when read

    def __post_init__(self) -> None:
        expect(self, "positive", "image_scale")


@dataclass(frozen=True)
class ModelSettings:
    """Sizes of the conditional VAE (paper, sections 3.2 to 3.4). Sizes in texels are powers of two.

    Widths of a branch are listed from coarse to fine, one a doubling of the map; where a size asks for more, the last is repeated.

    Raises:
        ValueError: if a size is no power of two, or sizes and lists of widths do not fit each other.
    """

    use_latent: bool = True  # False: no encoder, no z (the paper's pose+face baseline)
    use_localization: bool = True  # False: the driving signal reaches every location of the conditioning maps
    use_compression: bool = True  # False: masked signals enter the decoder without the two-layer projection
    use_shadow: bool = True  # False: no ambient-occlusion-fed gain map
    latent_size: int = 16  # entries of z (paper: 512); 128 did not fit the embedded capture better (docs/results/default_fit.md)
    conditioning_size: int = 32  # texels of the driving-signal maps e_theta, e_f (paper: 32)
    latent_channels: tuple[int, ...] = (64, 48, 32)  # features from z, each a doubling on; the last at conditioning_size
    pose_embedding_channels: int = 16  # of e_theta
    face_embedding_channels: int = 8  # of e_f
    decoder_channels: tuple[int, ...] = (64, 64)  # trunk: convolutions at conditioning_size, shared by geometry and texture
    decoder_kernel: int = 3  # width of the trunk's kernels; 1 keeps signals from crossing the borders between charts of the atlas
    geometry_channels: tuple[int, ...] = (24,)  # features at 2x, 4x, ... conditioning_size, up to half of geometry_size
    geometry_size: int = 128  # texels of the displacement map
    texture_channels: tuple[int, ...] = (48, 16)  # features at 2x, 4x, ... conditioning_size, up to half of texture_size
    texture_size: int = 256
    view_channels: tuple[int, ...] = (16, 16)  # hidden features of the view branch, all at view_size
    view_size: int = 64  # texels of what the camera's direction adds to the texture; at most half of texture_size
    encoder_size: int = 128  # texels of the position map that the encoder reads
    encoder_channels: tuple[int, ...] = (16, 24, 32, 48, 64)  # each entry halves the map
    shadow_channels: tuple[int, ...] = (8, 16, 24)  # UNet levels; it runs at texture_size / shadow_downscale
    shadow_downscale: int = 4  # paper: a quarter of the texture's resolution
    displacement_scale: float = 0.02  # metres that one unit of decoder output moves a vertex
    texture_scale: float = 0.2  # radiance that one unit of decoder output adds to the mean texture

    def __post_init__(self) -> None:
        expect(self, "positive", "latent_size", "latent_channels", "pose_embedding_channels", "face_embedding_channels")
        expect(self, "positive", "decoder_channels", "geometry_channels", "texture_channels", "view_channels")
        expect(self, "positive", "encoder_channels", "shadow_channels", "displacement_scale", "texture_scale")
        expect(self, "odd", "decoder_kernel")
        expect(self, "a power of two", "conditioning_size", "geometry_size", "texture_size")
        expect(self, "a power of two", "view_size", "encoder_size", "shadow_downscale")
        for name, least in (("geometry_size", 1), ("texture_size", 2), ("view_size", 1)):
            if getattr(self, name) < least * self.conditioning_size:
                raise ValueError(
                    f"ModelSettings(): expected {name} to be at least {'conditioning_size' if least == 1 else 'twice conditioning_size'} "
                    f"({least * self.conditioning_size}); got {getattr(self, name)}. Raise it, or lower conditioning_size."
                )
        if self.view_size > self.texture_size // 2:
            raise ValueError(
                f"ModelSettings(): expected view_size to be at most half of texture_size ({self.texture_size // 2}); got {self.view_size}. "
                "Lower it."
            )
        halvings = (("latent", self.conditioning_size, 1), ("encoder", self.encoder_size, 0), ("shadow", self.shadow_size, 1))
        for name, size, free in halvings:
            widths = getattr(self, f"{name}_channels")
            if size >> (len(widths) - free) < 1:
                raise ValueError(
                    f"ModelSettings(): expected {name}_channels to halve a map of {size} texels to no less than one; got {widths}. "
                    "Use fewer entries."
                )

    @property
    def shadow_size(self) -> int:
        """Texels of the ambient-occlusion and gain maps."""
        return self.texture_size // self.shadow_downscale


@dataclass(frozen=True)
class RenderingSettings:
    """The differentiable surface renderer and ambient occlusion."""

    variant: str = "auto"  # auto: cuda_ad_rgb where it works, llvm_ad_rgb otherwise
    samples_per_pixel: int = 4  # primal rays per pixel; with 1, the image loss pays for aliasing noise and blurs the texture instead
    boundary_samples_per_edge: int = 4  # stratified positions on every contour edge
    ambient_occlusion_rays: int = 64  # per texel
    ambient_occlusion_distance: float = 0.6  # metres; hits farther away do not occlude

    def __post_init__(self) -> None:
        expect(self, "positive", "samples_per_pixel", "boundary_samples_per_edge", "ambient_occlusion_rays", "ambient_occlusion_distance")


@dataclass(frozen=True)
class LossSettings:
    """Weights of the named loss terms (paper, section 3.6). A term with weight zero is not evaluated. Units: see training.losses."""

    image: float = 1.0  # per unit of absolute colour difference, averaged over the foreground
    mask: float = 0.5  # per fraction of the foreground that is covered wrongly
    geometry: float = 1.0  # per square centimetre of mean squared vertex distance
    laplacian: float = 1.0  # per square centimetre of mean squared difference of mesh Laplacians
    kl: float = 2e-4  # per nat and pose, summed over the latent code; variational preferencing (section 3.5.1) is to raise it
    kl_warm_up: int = 0  # iterations over which the weight of `kl` rises to its full size; for codes that die before they are of use
    mutual_information: float = 0.0  # per nat that the latent code is estimated to tell about the driving signal (section 3.5.2)
    perturbation: float = 0.0  # per square centimetre that a latent code drawn from the prior moves the driven keypoints (section 3.5.3)
    geometry_iterations: int = 300  # mesh supervision ends here (paper: 2000)
    geometry_after: float = 0.3  # factor on `geometry` after that; 0 as in the paper, where the tracked mesh is worse than the images

    def __post_init__(self) -> None:
        expect(self, "zero or more", "image", "mask", "geometry", "laplacian", "kl", "geometry_iterations", "geometry_after")
        expect(self, "zero or more", "kl_warm_up", "mutual_information", "perturbation")

    @property
    def looks_at_images(self) -> bool:
        """Whether a fit learns from pictures; otherwise from registered meshes alone, as a rehearsal does, and no image is read."""
        return self.image > 0 or self.mask > 0


@dataclass(frozen=True)
class DisentanglementSettings:
    """The estimator of mutual information between latent code and driving signal; its weight is `loss.mutual_information`."""

    statistics_channels: int = 128  # hidden features of the statistics network
    memory: int = 512  # recent posteriors, with their driving signals, that it learns from; old ones show an encoder that is gone
    pairs: int = 128  # drawn from the memory for each update, and remembered driving signals that a batch is compared with
    updates: int = 2  # of the statistics network, a step of the avatar
    statistics_learning_rate: float = 1e-3  # of its own optimizer
    moving_average: float = 0.05  # rate of the average that corrects the biased gradient

    def __post_init__(self) -> None:
        expect(self, "positive", "statistics_channels", "memory", "pairs", "updates", "statistics_learning_rate")
        expect(self, "between 0 and 1", "moving_average")
        if self.pairs < 2:
            raise ValueError(f"DisentanglementSettings(): expected pairs of at least 2, to be mismatched; got {self.pairs}. Raise it.")


@dataclass(frozen=True)
class CameraResponseSettings:
    """What training learns of each camera beside the avatar; left out of every picture that is rendered (training/camera_response.py)."""

    blur: bool = False  # a blur of each camera
    bias: bool = False  # a coarse map of radiance that each camera adds to the person
    identity_camera: str = ""  # training camera that keeps neither; empty for the first
    bias_cells: int = 8  # along the longer side of an image
    bias_decay: float = 0.1  # of the bias, per unit of learning rate and step
    learning_rate: float = 5e-3  # of both; square pixels, linear radiance; falls with the avatar's

    def __post_init__(self) -> None:
        expect(self, "positive", "bias_cells", "learning_rate")
        expect(self, "zero or more", "bias_decay")

    @property
    def is_learnt(self) -> bool:
        """Whether there is anything to learn."""
        return self.blur or self.bias


@dataclass(frozen=True)
class TrainingSettings:
    """The optimisation loop."""

    iterations: int = 900
    poses_per_batch: int = 2  # batch size = poses_per_batch * views_per_pose (paper: 8)
    views_per_pose: int = 4
    learning_rate: float = 2e-3  # paper: 1e-3, for days of training
    learning_rate_final: float = 1e-4  # cosine decay ends here
    precision: str = "float32"  # of hidden layers; "mixed": bfloat16; "auto": mixed where the device has instructions for it
    gradient_clip: float = 1.0  # global norm
    explosion_factor: float = 10.0  # a step whose loss exceeds the running mean by this factor is skipped
    skipped_steps: int = 2  # bad steps within 20 iterations that a run survives
    seed: int = 0
    checkpoint_every: int = 200
    validate_every: int = 200
    preview_every: int = 200

    def __post_init__(self) -> None:
        expect(self, "positive", "iterations", "poses_per_batch", "views_per_pose", "learning_rate", "learning_rate_final", "gradient_clip")
        expect(self, "positive", "checkpoint_every", "validate_every", "preview_every")
        expect(self, "positive", "explosion_factor")
        expect(self, "zero or more", "seed", "skipped_steps")
        if self.precision not in PRECISIONS:
            raise ValueError(
                f"TrainingSettings(): expected precision to be one of {', '.join(PRECISIONS)}; got {self.precision!r}. Change it."
            )


@dataclass(frozen=True)
class EvaluationSettings:
    """What the end of a fit measures and draws."""

    frames_per_split: int = 12  # evenly spaced frames of each split
    orbit_frames: int = 36
    orbit_width: int = 360
    orbit_height: int = 540
    samples_per_pixel: int = 16

    def __post_init__(self) -> None:
        expect(self, "positive", "frames_per_split", "orbit_frames", "orbit_width", "orbit_height", "samples_per_pixel")


@dataclass(frozen=True)
class Settings:
    """All sections of a fit."""

    capture: CaptureSettings = field(default_factory=CaptureSettings)
    model: ModelSettings = field(default_factory=ModelSettings)
    rendering: RenderingSettings = field(default_factory=RenderingSettings)
    loss: LossSettings = field(default_factory=LossSettings)
    disentanglement: DisentanglementSettings = field(default_factory=DisentanglementSettings)
    training: TrainingSettings = field(default_factory=TrainingSettings)
    camera_response: CameraResponseSettings = field(default_factory=CameraResponseSettings)
    evaluation: EvaluationSettings = field(default_factory=EvaluationSettings)
