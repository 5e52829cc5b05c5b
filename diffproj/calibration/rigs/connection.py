"""What connects the cameras of a rig: the moments at which two and more of them see the target.

Where one moment alone does, a fault in it goes into the places of all cameras behind it, and no residual shows that.
"""

from collections.abc import Iterable, Mapping

from diffproj.calibration.rigs.fit import RigFit

MOST_NAMED = 5
"""Moments that a message names."""


def single_moments(found: RigFit) -> list[str]:
    """A remark on each group of cameras that one moment alone connects with the first, or with those that are held."""
    names, held, parameters = found.views.names, set(found.positions), found.parameters
    seen: dict[int, set[int]] = {}
    for c, name in enumerate(names):
        for moment in found.views.where[name][found.used[name].any(-1)].tolist():
            seen.setdefault(moment, set()).add(c)
    placed = {0, *(c for c in range(1, len(names)) if parameters.pose(c).start in held)}
    said = []
    for moment in _only_ones(seen):
        rest = [placed, *(cameras for other, cameras in seen.items() if other != moment)]
        for group in _groups(len(names), rest):
            if 0 not in group and group & seen[moment]:
                these, own = (
                    _listed([names[c] for c in sorted(group)]),
                    "its place" if len(group) == 1 else "their places",
                )
                said.append(
                    f"one moment alone connects {these} with the other cameras, {found.views.moments[moment]}: nothing "
                    f"checks {own}"
                )
    return said


def set_apart(found: RigFit) -> str:
    """Which cameras contradict the others, and at which moments, in words; empty where none does."""
    said = []
    for name in found.views.names:
        at = [found.views.moments[i] for i in found.views.where[name][found.apart[name]].tolist()]
        if at:
            more = f" and {len(at) - MOST_NAMED} more" * (len(at) > MOST_NAMED)
            said.append(f"{name} at {', '.join(at[:MOST_NAMED])}{more}")
    return ", ".join(said)


def _only_ones(seen: Mapping[int, set[int]]) -> list[int]:
    """Moments at which two cameras are seen together that are at no other."""
    together: dict[tuple[int, int], list[int]] = {}
    for moment, cameras in seen.items():
        for one in cameras:
            for other in cameras:
                if one < other:
                    together.setdefault((one, other), []).append(moment)
    return sorted({at[0] for at in together.values() if len(at) == 1})


def _groups(cameras: int, together: Iterable[set[int]]) -> list[set[int]]:
    """The cameras in groups that are connected by those that are seen together."""
    groups = [{c} for c in range(cameras)]
    for ones in together:
        touched = [group for group in groups if group & ones]
        if len(touched) > 1:
            groups = [group for group in groups if not group & ones] + [set().union(*touched)]
    return groups


def _listed(names: list[str]) -> str:
    return " and ".join(filter(None, [", ".join(names[:-1]), names[-1]]))
