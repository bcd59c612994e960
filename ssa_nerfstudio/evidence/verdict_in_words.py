"""The verdict of a detection as a sentence."""

from __future__ import annotations

from ssa_nerfstudio._system.counted_noun import counted
from ssa_nerfstudio.evidence.detection import MIN_VIEWS, Detection, Interval

_KINDS = {"faint": "semi-transparent", "opaque": "opaque, at least in part"}


def verdict_in_words(detection: Detection) -> str:
    """One sentence without a period: what was found, how much of the frame it covers, and how sure that is."""
    photos = counted(detection.views, "photo")
    if detection.views < MIN_VIEWS:
        return f"too few photos ({detection.views}) to tell whether they have a static artifact; {MIN_VIEWS} are needed"
    if detection.too_few_edges:
        return f"no static artifact in {photos}: some edges stand still, but too few to be one"
    if detection.verdict == "none":
        return f"no static artifact in {photos}"
    if detection.nothing_moves:
        return f"nothing moves in {photos}: are they of one view? Those of a scene are taken from many"
    if detection.intervals:
        return f"an artifact that changes: {', '.join(map(_interval_in_words, detection.intervals))}"
    return (
        f"a static artifact over {detection.coverage:.1%} of the frame, {_KINDS[detection.verdict]}, in {photos} "
        f"(chance of a false alarm at most {detection.p_interval[1]:.1%})"
    )


def _interval_in_words(part: Interval) -> str:
    kind = _KINDS.get(part.verdict)
    what = "none" if kind is None else f"{part.coverage:.1%} of the frame, {kind}"
    return f"in photos {part.first + 1} to {part.end} {what}"
