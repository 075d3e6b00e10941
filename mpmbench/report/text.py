"""Values -> text, the same in every form of report."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from mpmbench.report.table import Quantity

MISSING = "–"
LEFT = (Quantity.TEXT, Quantity.PROSE, Quantity.CODE)  # aligned left; an empty cell of these stays empty


def format_value(value: Any, quantity: Quantity) -> str:
    """Text of one cell, without markup."""
    if value is None or value == "":
        return MISSING if quantity not in LEFT else ""
    if isinstance(value, str):
        return value
    match quantity:
        case Quantity.TEXT | Quantity.PROSE | Quantity.CODE | Quantity.RANK:
            return str(value)
        case Quantity.PRINTED:
            return f"{value:,.10g}"
        case Quantity.COUNT:
            return f"{value:,.0f}"
        case Quantity.BYTES:
            return bytes_text(value)
        case Quantity.SECONDS:
            return seconds_text(value)
        case Quantity.SECONDS_RANGE:
            return range_text(value[0], value[1], seconds_text)
        case Quantity.TRANSFERS_RANGE:
            return range_text(value[0], value[1], transfers_text)
        case Quantity.RATE:
            return scaled(value, 1000, ("", " k", " M", " G", " T"))
        case Quantity.FACTOR:
            return f"{number(value)}×"
        case Quantity.FACTOR_INTERVAL:
            return interval_text(*value)
        case Quantity.SHARE:
            return f"{100 * value:.1f} %"
        case Quantity.TRANSFERS:
            return transfers_text(value)
    return number(value)


def number(value: float) -> str:
    """Three significant digits, whole above 1000."""
    if isinstance(value, bool) or not math.isfinite(value):
        return str(value)
    whole = float(value).is_integer()
    value = float(f"{value:.3g}") if abs(value) < 1000 else value  # so that 9.996 is 10.0 and not 10.00
    size = abs(value)
    if size == 0:
        return "0"
    if size >= 1e9:
        return f"{value:.3g}"
    if size >= 1000:
        return f"{value:,.0f}"
    if size < 1e-3:
        return f"{value:.1e}"
    decimals = 2 - math.floor(math.log10(size))
    text = f"{value:.{max(decimals, 0)}f}"
    return text.rstrip("0").rstrip(".") if "." in text and whole else text


def scaled(value: float, base: int, units: tuple[str, ...]) -> str:
    """Three significant digits of the largest unit that leaves at least one."""
    power = 0
    while abs(value) >= base and power < len(units) - 1:
        value /= base
        power += 1
    return f"{number(value)}{units[power]}"


def bytes_text(value: float) -> str:
    return scaled(value, 1024, (" B", " KiB", " MiB", " GiB", " TiB"))


def seconds_text(value: float) -> str:
    return scaled(value * 1e9, 1000, (" ns", " µs", " ms", " s"))


def range_text(low: float, high: float, words: Callable[[float], str]) -> str:
    """Both ends, once where they read the same; their unit once where they share it."""
    first, last = words(low), words(high)
    if first == last:
        return first
    (value, *unit), (_, *other) = first.split(), last.split()
    return f"{value} to {last}" if unit == other else f"{first} to {last}"


def interval_text(median: float, low: float, high: float) -> str:
    """A factor and its interval, to the digit that the interval knows."""
    if not math.isfinite(median):
        return MISSING
    if not (math.isfinite(low) and math.isfinite(high)):
        return f"{number(median)}×, no interval"
    half = (high - low) / 2
    decimals = min(3, max(2 if abs(median) < 10 else 0, -math.floor(math.log10(half)))) if half > 0 else 2
    return f"{median:,.{decimals}f}× [{low:,.{decimals}f}, {high:,.{decimals}f}]"


def transfers_text(value: float) -> str:
    """A break-even in words where there is a word for it."""
    if math.isinf(value):
        return "never"
    return "at once" if value <= 1 else f"{value:,.0f}"
