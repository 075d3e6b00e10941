"""Errors a user can cause or mend. Each message is one line: what is wrong, where, and what to do."""

from __future__ import annotations


class MpmbenchError(Exception):
    """Base of every error that mpmbench raises on purpose; the command line prints it without a traceback."""

    exit_code = 1


class InputError(MpmbenchError):
    """Bad input or usage: unknown name, missing or malformed file, NaN, particle outside the grid, wrong
    shape or dtype, no GPU, no compiler, full disk. Exit code 2."""

    exit_code = 2
