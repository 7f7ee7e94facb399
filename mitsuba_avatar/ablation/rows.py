"""The rows of the ablation table, their presets, and the figures that the paper gives for them.

Source: arXiv:2105.10441, section 4.3 and Table 1.
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class Row:
    """One way of building the avatar.

    Attributes:
        name: of its preset in configs/ablation/.
        title: as the table says it.
        published: image error on train and test samples in the paper's table, in mean squared 0..255 values; None where it has no figure.
    """

    name: str
    title: str
    published: tuple[float, float] | None = None

    @property
    def preset(self) -> str:
        """Name of the preset."""
        return f"ablation/{self.name}"


ROWS = (
    Row("ours", "ours", (11.578, 15.546)),
    Row("pose_face", "pose+face", (7.647, 17.509)),
    Row("pose_face_latent", "pose+face+latent", (14.861, 19.885)),
    Row("without_disentanglement", "ours, no disentanglement", (11.926, 16.364)),
    Row("without_localization", "ours, no spatial localization", (9.424, 16.461)),
    Row("without_shadow", "ours, no shadow", (10.872, 16.792)),
    Row("without_compression", "ours, no compression"),  # section 4.3 says only that it fits the training samples best
)


def choose_rows(names: str) -> tuple[Row, ...]:
    """Rows by name, in the table's order.

    Args:
        names: separated by commas; empty for all.

    Raises:
        ValueError: a name that is no row's.
    """
    wanted = [name.strip() for name in names.split(",") if name.strip()]
    known = [row.name for row in ROWS]
    unknown = [name for name in wanted if name not in known]
    if unknown:
        raise ValueError(f"choose_rows(): expected rows among {', '.join(known)}; got {', '.join(unknown)}. Change --rows.")
    return tuple(row for row in ROWS if not wanted or row.name in wanted)
