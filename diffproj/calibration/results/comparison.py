"""`LensComparison`: how the lenses fared that `calibrate(..., distortion="auto")` compared."""

from dataclasses import dataclass
from typing import Any, Literal

from jaxtyping import Float
from torch import Tensor

from diffproj._core.shown import Shown
from diffproj.lens.models import MODELS, LensModel


@dataclass(frozen=True, eq=False, repr=False)
class LensComparison(Shown):
    """Lenses side by side, from the simplest to the richest.

    Attributes:
        models: their names.
        chosen: the one that was taken.
        held_out: what the errors were judged by: `"views"` left out in turn, located from every second of their corners
            and judged by the others; or, where there are few views, every second of the `"corners"` of each.
        fitted_px: RMS reprojection error of the fit to all corners `(m,)`, in pixels; infinite where it failed.
        held_out_px: the same for corners held out, `(m,)`; infinite where a fit without them failed, or lost some.
        worse_px: by how much that is more than the best's `(m,)`.
        deviation_px: the standard deviation of this difference, from view to view, `(m,)`.
        causes: why a fit failed; empty where it did not.
    """

    models: tuple[LensModel, ...]
    chosen: LensModel
    held_out: Literal["views", "corners"]
    fitted_px: Float[Tensor, " m"]
    held_out_px: Float[Tensor, " m"]
    worse_px: Float[Tensor, " m"]
    deviation_px: Float[Tensor, " m"]
    causes: tuple[str, ...]

    def to_dict(self) -> dict[str, list[Any]]:
        """The lenses as columns of Python's own numbers and words: `pandas.DataFrame` takes it."""
        names = "fitted_px", "held_out_px", "worse_px", "deviation_px"
        columns: dict[str, list[Any]] = {"model": list(self.models)}
        columns |= {name: getattr(self, name).tolist() for name in names}
        return columns | {"cause": list(self.causes)}

    def _facts(self) -> list[str]:
        return [f"{self.chosen} of {', '.join(self.models)}", f"by held-out {self.held_out}"]

    def _columns(self) -> dict[str, list[Any]]:
        return self.to_dict()

    def summary(self) -> str:
        """A table of text; a star marks the lens that was taken."""
        lines = ["  lens      coefficients   fitted px   held out px   worse than the best, px"]
        columns = [self.fitted_px, self.held_out_px, self.worse_px, self.deviation_px]
        for name, cause, *numbers in zip(self.models, self.causes, *(c.tolist() for c in columns), strict=True):
            fitted, held_out, worse, deviation = numbers
            line = f"{'*' * (name == self.chosen):<2}{name:<10}{MODELS[name].count:12d}"
            if cause:
                lines.append(f"{line}   {cause}")
            elif worse == 0:
                lines.append(f"{line}{fitted:12.4f}{held_out:14.4f}   the best")
            else:
                lines.append(f"{line}{fitted:12.4f}{held_out:14.4f}   {worse:.4f} \u00b1 {deviation:.4f}")
        return "\n".join([*lines, f"Held out were {self.held_out}; the simplest that is no worse is taken."])
