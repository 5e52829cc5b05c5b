"""Effects that explain little of the residuals, and yet move the camera by more than its deviations say.

With many views the error bars become narrow, and a board that is bent by a thousandth of its width, printed a little
wider than high, or seen through a K with a little skew, moves the focal lengths by several of their deviations while
it explains a few hundredths of the residuals. It is no noise, so that more views do not help. But it is a clear effect,
and the same step that predicts what it explains predicts by how much it moves the parameters: where that is a good part
of a deviation, it is worth a word.
"""

from functools import cached_property

from torch import Tensor

from diffproj.calibration.fitting.fit import Fit
from diffproj.calibration.problem.parametrisation import INTRINSICS
from diffproj.calibration.results.covariance import Covariance
from diffproj.calibration.results.remark import Kind, Remark
from diffproj.calibration.trust.adequacy import SHAPE_VIEWS
from diffproj.calibration.trust.leftover import Effect, Leftover
from diffproj.calibration.trust.uncertainty import covariance_of

CLEAR = 4.0
"""Standard deviations from which on one or two unknowns alone are none of chance."""
CLEAR_ALONE = 6.0
"""The same from which on skew is worth a word wherever it moves anything: boards turn by it."""
MATTERS = 0.7
"""Part of its deviation by which a focal length or a coordinate of the principal point must move."""


class SmallEffects:
    """What is worth a word of the small effects on some cameras `(n,)` of a fit."""

    def __init__(self, found: Fit, which: Tensor, left: Leftover, of_landmarks: bool) -> None:
        self.found, self.which, self.left = found, which, left
        task = found.task
        self.of_board = not of_landmarks and not task.solid and not task.free
        self.enough = task.used.any(-1).sum(-1) >= SHAPE_VIEWS

    def of(self, i: int) -> Remark | None:
        """That of the largest effect on number `i` of the cameras; none where none moves it."""
        task, left, p = self.found.task, self.left, int(self.which[i])
        effects = [] if task.skew else [(Kind.SKEW, left.skew)]
        if self.of_board and bool(self.enough[p]):
            effects += [(Kind.UNEVEN_PRINT, left.print)] + ([] if task.bow else [(Kind.BENT, left.bow)])
        moved = {kind: self._moved(effect, i, kind) for kind, effect in effects}
        shares = {kind: float(effect.share[i]) for kind, effect in effects if moved[kind] > 0}
        if not shares:
            return None
        kind = max(shares, key=lambda each: shares[each])
        tied = task.basis is not None and bool((task.basis[p, 0] * task.basis[p, 1]).any())
        return _remark(kind, shares[kind], moved[kind], tied)

    def _moved(self, effect: Effect, i: int, kind: Kind) -> float:
        """By how many deviations it moves an intrinsic parameter at most; 0 where it is no clear effect on any."""
        far = float(effect.deviations[i])
        if effect.moved is None or far <= CLEAR:
            return 0.0
        p = int(self.which[i])
        deviations = self._deviations[p]
        moves = effect.moved[i, : len(INTRINSICS)].abs() / deviations
        most = float(moves[deviations > 0].nan_to_num(0.0).amax()) if bool((deviations > 0).any()) else 0.0
        alone = kind == Kind.SKEW and far > CLEAR_ALONE * float(self._dispersion[p]) ** 0.5
        return max(most, 1e-3) if most > MATTERS or alone else 0.0

    @cached_property
    def _deviations(self) -> Tensor:
        """Of the intrinsic parameters of all cameras `(P, 4)`."""
        variance = self._covariance.shared.diagonal(dim1=-2, dim2=-1)[:, : len(INTRINSICS)]
        return variance.detach().sqrt()

    @property
    def _dispersion(self) -> Tensor:
        return self._covariance.dispersion.detach()

    @cached_property
    def _covariance(self) -> Covariance:
        return covariance_of(self.found)


def _remark(kind: Kind, share: float, moved: float, tied: bool) -> Remark:
    """What is said of an effect that explains a part of the residuals and moves the camera by so many deviations."""
    much = f"moves focal lengths or the principal point by {moved:.1f} of their deviations"
    much = much if moved > MATTERS else "turns the boards, and hardly moves the camera"
    that = f"which explains {100 * share:.2g} % of the residuals' sum of squares and {much}"
    if kind == Kind.SKEW:
        return Remark(f"K seems to have a little skew, {that}: take skew=True", kind, "K has a little skew")
    if kind == Kind.BENT:
        remedy = "take shape='bow', or glue the board to something flat"
        return Remark(f"the board seems to be a little bent, {that}: {remedy}", kind, "the board is a little bent")
    remedy = "take shape='free', which finds that, or measure both sides of the whole board"
    if tied:
        sentence = f"the pixels seem not to be quite square, or the board not as wide and as high as it says, {that}"
        return Remark(
            f"{sentence}: take tied_focal=False; or {remedy}", kind, "the pixels or the board's squares are not square"
        )
    return Remark(
        f"the board seems to be a little wider than high by more than it says, or less, or slanted, {that}: {remedy}",
        kind,
        "the board is not quite as wide and as high as it says",
    )
