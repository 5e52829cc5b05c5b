"""What is to be known of a calibration that converged: where its lens ends, and what its model leaves over."""

import torch
from torch import Tensor

from diffproj.calibration.fit import Fit
from diffproj.calibration.reach import reaches_image
from diffproj.calibration.solver import Status


def remarks(found: Fit, status: Tensor, size: tuple[int, int] | None) -> tuple[str, ...]:
    """The remarks on each of P cameras, in one text; empty where there are none, or it did not converge."""
    task, shared = found.task, found.solution.shared.detach()
    held = torch.zeros_like(status, dtype=torch.bool)
    if task.prior is not None and task.prior.known is not None:
        held = (task.prior.precision != task.prior.known).any(-1).any(-1)
    reach = reaches_image(task, shared, size) if size is not None else torch.ones_like(shared[:, 0])
    texts = []
    for p, code in enumerate(status.tolist()):
        found_out = []
        if held[p]:
            found_out.append("k4, k5 and k6 are drawn towards 0, for without that the lens folds inside the image")
        if reach[p] < 1:
            found_out.append(
                f"{100 * (1 - float(reach[p])):.0f} % of the image's border lies beyond the fold of the lens, and its "
                "pixels have no ray: bring the board there"
            )
        texts.append("; ".join(found_out) if code == Status.CONVERGED else "")
    return tuple(texts)
