"""How much of a long measurement is done, in seconds of rendering that were planned for it."""

from __future__ import annotations

from collections.abc import Callable


class Workload:
    """Planned seconds of each part, and the finished fraction that follows.

    Plans start as guesses and get better while the work goes on; where all are too short by the
    same factor the fraction is right nevertheless.
    """

    def __init__(self, guesses: dict[str, float], report: Callable[[float], None]) -> None:
        self.left, self.done, self.report = dict(guesses), 0.0, report

    def expect(self, part: str, seconds: float) -> None:
        """Set what is left of a part."""
        self.left[part] = max(seconds, 0.0)

    def finish(self, part: str, seconds: float) -> None:
        """Take note that work of a part is done that was planned to take ``seconds``."""
        self.left[part] = max(self.left[part] - seconds, 0.0)
        self.done += seconds
        total = self.done + sum(self.left.values())
        if total > 0.0:
            self.report(self.done / total)
