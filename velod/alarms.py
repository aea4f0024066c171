"""What is wrong at the moment, by name, in words: stages keep it, health tells it."""

from __future__ import annotations


class Alarms(dict[str, str]):
    """Those that stand, ``name -> what is wrong``."""

    def say(self, name: str, text: str) -> None:
        """``text`` is what is wrong from now on; where it is empty, nothing is any more."""
        if text:
            self[name] = text
        else:
            self.pop(name, None)
