"""Numbers as people read them: as many digits as the standard deviation allows, change in percent."""

import math

SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
BEYOND = 100.0  # misfit that says no more than that a model moves by itself
MISSING = "\N{EN DASH}"
DASH = " \N{EN DASH} "
TIMES = " \N{MULTIPLICATION SIGN} "


def power_of_ten(exponent: int) -> str:
    return "10" + str(exponent).translate(SUPERSCRIPTS)


def minus(text: str) -> str:
    """The same with the proper minus sign."""
    return text.replace("-", "\N{MINUS SIGN}")


def exponent_of(value: float) -> int:
    return math.floor(math.log10(abs(value))) if value else 0


def significant(value: float, digits: int = 4) -> str:
    """The value rounded to so many significant digits; a power of ten where it is huge or tiny."""
    if not math.isfinite(value):
        return MISSING
    if value == 0:
        return "0"
    exponent = exponent_of(float(f"{value:.{digits - 1}e}"))
    if -4 <= exponent < 6:
        return minus(f"{value:.{max(digits - 1 - exponent, 0)}f}")
    return minus(f"{value / 10.0**exponent:.{digits - 1}f}") + TIMES + power_of_ten(exponent)


def with_std(value: float, std: float | None, digits: int = 5) -> str:
    """value ± std: the deviation with two digits, the value with as many decimals; at most eight digits."""
    if not math.isfinite(value):
        return MISSING
    if std is None or not math.isfinite(std) or std <= 0:
        return significant(value, digits)
    exponent = exponent_of(max(abs(value), std))
    if exponent - exponent_of(std) > 6:
        return f"{significant(value, 8)} ± {significant(std, 1)}"
    decimals = 1 - exponent_of(float(f"{std:.1e}"))
    if -4 <= exponent < 6:
        places = max(decimals, 0)
        return minus(f"{value:.{places}f} ± {std:.{places}f}")
    scale, places = 10.0**exponent, max(decimals + exponent, 0)
    return minus(f"({value / scale:.{places}f} ± {std / scale:.{places}f})") + TIMES + power_of_ten(exponent)


def change(value: float, reference: float) -> str:
    """By how much the value differs from the reference, in percent of it."""
    if not (math.isfinite(value) and math.isfinite(reference)) or reference == 0:
        return MISSING
    percent = 100 * (value / reference - 1)
    return minus(f"{percent:+.{1 if abs(percent) >= 0.95 else 2}f} %")


def percent(share: float) -> str:
    """A share in percent, three significant digits."""
    return f"{significant(100 * share, 3)}\N{NO-BREAK SPACE}%" if math.isfinite(share) else MISSING


def misfit(nrmse: float) -> str:
    """A misfit in percent; a motion that grows beyond all measure has no useful number."""
    return f"over {percent(BEYOND)}" if nrmse > BEYOND else percent(nrmse)


def plural(count: int, noun: str) -> str:
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def share_of(probability: float) -> str:
    """A probability in percent, without digits that it does not have.

    Args:
        probability: from 0 to 1.
    """
    if probability > 0.99:
        return "above 99 %"
    return percent(probability) if probability >= 0.001 else "below 0.1 %"


def chance(p_value: float) -> str:
    """The probability of something by chance.

    Args:
        p_value: from 0 to 1.
    """
    return "below 10⁻¹⁰" if p_value < 1e-10 else significant(p_value, 2)
