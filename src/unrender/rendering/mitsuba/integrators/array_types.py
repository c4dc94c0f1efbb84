"""Names for the per-lane arrays in annotations.

Mitsuba's stubs take `mitsuba.Float` and the `drjit.auto.ad.Float` of its methods for two types, likewise the others, and know no products
of a spectrum and a number. So to a type checker these are any type; to a reader, `mi.Float`, `mi.Bool`, `mi.UInt32` and `mi.Spectrum`.
"""

from __future__ import annotations

from typing import Any, TypeAlias

Float: TypeAlias = Any
Bool: TypeAlias = Any
UInt32: TypeAlias = Any
Spectrum: TypeAlias = Any
