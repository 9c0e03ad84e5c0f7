"""Times as recordings write them: seconds, milli-, micro- or nanoseconds, or a date; told by their magnitude."""

from collections.abc import Sequence
from contextlib import suppress
from datetime import UTC, datetime
from decimal import Decimal, InvalidOperation

from deepsimbad_client.errors import SourceError

UNITS = {"s": Decimal(10**6), "ms": Decimal(1000), "us": Decimal(1), "ns": Decimal("0.001")}  # in microseconds
FIRST_US, LAST_US = 631_152_000 * 10**6, 4_102_444_800 * 10**6  # 1990 to 2100: no two units overlap


def unit_of(time: Decimal) -> str | None:
    """The unit in which a number is a time since 1970 between 1990 and 2100; None: in none."""
    return next((unit for unit, in_us in UNITS.items() if FIRST_US <= time * in_us < LAST_US), None)


def times_us(cells: Sequence[str], unit: str | None, where: Sequence[str]) -> tuple[list[int | None], str | None]:
    """Whole microseconds of the cells of a column, None where one says nothing; and the unit they are in.

    `unit` is what the column's name says; numbers that are times of day since 1970 in another one are of that other
    one. `where` names each cell in errors. Raises SourceError (no time, or of a unit that cannot be told).
    """
    numbers = [_number(cell, place) for cell, place in zip(cells, where, strict=True)]
    known = [(number, place) for number, place in zip(numbers, where, strict=True) if number]
    units = {unit_of(number): place for number, place in known}
    if len(units) > 1:
        mixed = "; ".join(f"{place} is in {unit_ or 'none'}" for unit_, place in units.items())
        raise SourceError(f"times of several units: {mixed}; write all of them in microseconds (timestamp_us)")
    unit = next(iter(units), None) or unit
    if unit is None and known:
        raise SourceError(
            f"{known[0][1]}: nobody can tell the unit of the time {known[0][0]}: name the column timestamp_s, "
            "timestamp_ms, timestamp_us or timestamp_ns"
        )
    if unit is None:
        return [None] * len(cells), None
    since_1970 = unit in units  # there 0 is no time but its absence
    times: list[int | None] = []
    for number, place in zip(numbers, where, strict=True):
        if number is not None and abs(number) * UNITS[unit] >= LAST_US:
            raise SourceError(f"{place}: {number} {unit} is no time, it is after the year 2100")
        times.append(None if number is None or (since_1970 and not number) else round(number * UNITS[unit]))
    return times, unit


def _number(cell: str, where: str) -> Decimal | None:
    if cell.lower() in UNKNOWN:
        return None
    with suppress(InvalidOperation):
        number = Decimal(cell)
        if not number.is_finite():
            raise SourceError(f"{where}: {cell!r} is not a time")
        return number
    try:
        date = datetime.fromisoformat(cell)
    except ValueError as error:
        raise SourceError(f"{where}: {cell!r} is not a time") from error
    return Decimal(round((date if date.tzinfo else date.replace(tzinfo=UTC)).timestamp() * 1e6)) / 10**6


UNKNOWN = frozenset({"", "-", "nan", "+nan", "-nan", "inf", "+inf", "-inf", "null", "none", "na", "n/a", "#n/a", "--"})
"""What tables write where nothing is known."""
