"""What a bad command line gets: one line on stderr and status 2."""

from collections.abc import Callable, Sequence
from typing import Any

import pytest


def refused(main: Callable[[list[str]], None], argv: Sequence[str], capsys: Any) -> str:
    """The one line; there is no traceback and no other status."""
    with pytest.raises(SystemExit) as stop:
        main(list(argv))
    assert stop.value.code == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "Traceback" not in error
    return error
