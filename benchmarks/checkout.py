"""The type of arguments that are checkouts of this repository."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click


class Checkout(click.Path):
    """A folder that holds this repository, at any commit that has the files that are asked for."""

    def __init__(self, *files: str) -> None:
        super().__init__(exists=True, file_okay=False, path_type=Path)
        self.files = files

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """The folder's path. Fails where a file is missing: Python would import an installed package instead."""
        path = Path(str(super().convert(value, param, ctx)))
        if missing := [file for file in self.files if not (path / file).is_file()]:
            self.fail(f"expected a checkout of this repository, got {path}, which has no {missing[0]}", param, ctx)
        return path
