"""The formulas of the chapters as plain text, for pages that hold no scripts to set them."""

import re

_GREEK = "alpha gamma delta epsilon mu pi rho sigma upsilon ell"
_SIGNS = "infty cdot times le ge lt gt approx in to sum ldots dots"
SYMBOLS = dict(zip(_GREEK.split() + _SIGNS.split(), "αγδεμπρσυℓ∞·×≤≥<>≈∈→Σ……", strict=True)) | {"bmod": "mod"}
"""Commands by what stands for them. Any other is its own name: max, ln, tanh."""
ACCENTS = {"tilde": "\N{COMBINING TILDE}", "hat": "\N{COMBINING CIRCUMFLEX ACCENT}"}
OPENING = {"lvert": "|", "lfloor": "⌊", "langle": "⟨", "pm": "±"}
CLOSING = {"rvert": "|", "rfloor": "⌋", "rangle": "⟩"}
RAISED = str.maketrans("0123456789-+n", "⁰¹²³⁴⁵⁶⁷⁸⁹⁻⁺ⁿ")
LOWERED = str.maketrans("0123456789", "₀₁₂₃₄₅₆₇₈₉")


def plain(text: str) -> str:
    """A text with each $formula$ in Unicode and each link as its words. What stands in `code` stays as it is."""
    text = re.sub(r"\[([^\]]+)\]\([^)]*\)", r"\1", text)
    return re.sub(r"(`[^`]*`)|\$([^$]+)\$", lambda found: found[1] or _formula(found[2]), text)


def _formula(tex: str) -> str:
    tex = re.sub(rf"\\({'|'.join(OPENING)})\s*", lambda found: OPENING[found[1]], tex)
    tex = re.sub(rf"\s*\\({'|'.join(CLOSING)})", lambda found: CLOSING[found[1]], tex)
    tex = re.sub(r"\\frac\{([^{}]*)\}\{([^{}]*)\}", r"\1/\2", tex)
    tex = re.sub(r"\\(?:text|mathrm|mathit)\{([^{}]*)\}", r"\1", tex)
    tex = re.sub(r"\\sqrt\{([^{}]*)\}", lambda found: f"√{_grouped(found[1])}", tex)
    tex = re.sub(r"\\(tilde|hat)\s*(\\?[A-Za-z]+)", lambda found: found[2] + ACCENTS[found[1]], tex)
    tex = re.sub(r"\\([A-Za-z]+)", lambda found: SYMBOLS.get(found[1], found[1]), tex)
    tex = re.sub(r"([_^])(?:\{([^{}]*)\}|(\S))", lambda found: _index(found[1], found[2] or found[3]), tex)
    return re.sub(r"\s+", " ", tex).strip()


def _index(mark: str, body: str) -> str:
    body = body.strip()
    table, known = (RAISED, r"-?[0-9]+|n") if mark == "^" else (LOWERED, "[0-9]+")
    return body.translate(table) if re.fullmatch(known, body) else mark + _grouped(body)


def _grouped(body: str) -> str:
    return body if re.fullmatch(r"\w+", body) else f"({body})"
