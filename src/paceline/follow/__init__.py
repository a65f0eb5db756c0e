"""Following the vehicle ahead with one camera.

The package itself can be called, ``paceline.follow(clip)``, as the verb and the folder have one name.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from types import ModuleType
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pathlib import Path

    from paceline.documents.loading import FollowClip
    from paceline.follow.configuration import FollowConfiguration
    from paceline.follow.results import FollowEstimate


class _CallablePackage(ModuleType):
    def __call__(
        self, clip: FollowClip | Path | str, configuration: FollowConfiguration | None = None
    ) -> Iterator[FollowEstimate]:
        """The estimates of ``clip``, frame by frame: see `paceline.follow.following.estimates`."""
        from paceline.follow.following import estimates

        return estimates(clip, configuration)


sys.modules[__name__].__class__ = _CallablePackage
