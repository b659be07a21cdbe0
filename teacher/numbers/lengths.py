"""Lengths that a text measures in objects, such as "about its own width".

A dimension of an object is a number if it measures a distance: "within a cube's length", "moves the
width of the sphere". It is none if it only names a part of the scene: "the width of the image",
"rolls along its length".
"""

from __future__ import annotations

import re

from data.records import COLORS, MATERIALS, SHAPES

_object = rf"(?:{'|'.join((*SHAPES, 'ball', 'block', 'object', 'body', 'puck'))})"
_look = rf"(?:{'|'.join((*COLORS, *MATERIALS, 'grey', 'small', 'large', 'other'))})"
_dimension = "(?:widths?|lengths?|diameters?|radius|radii|heights?|breadths?|sizes?)"
_measure = (
    "(?:about|roughly|nearly|almost|approximately|within|than|beyond|barely|hardly|by|exactly)"
)
_motion = r"(?:moves?|travels?|shifts?|advances?|drifts?|slides?|rolls?|covers?|spans?)"
_gap = "(?:gap|distance|space|separation)"
_article = "(?:an?|the|one)"
_noun = rf"(?:{_look}\s+){{0,3}}{_object}"
_owner = rf"(?:{_noun}['’]s\s+)?"
LENGTH = re.compile(
    rf"""\b(?:
        own\s+(?:full\s+)?{_dimension}
        | {_object}[\s-]+(?!sizes?){_dimension}
        | an?\s+{_noun}['’]s\s+{_dimension}
        | {_noun}['’]s\s+{_dimension}\s+(?:away|apart|from)
        | (?:its|their)\s+(?:(?:full|entire|whole)\s+{_dimension}|{_dimension}\s+(?:away|apart))
        | {_measure}\s+(?:the|its|their)\s+(?:{_look}\s+){{0,3}}{_owner}{_dimension}
          (?!\s+of\s+the\s+(?:image|view|scene|frame|picture))
        | (?:{_measure}|{_motion})\s+the\s+{_dimension}\s+of\s+{_article}\s+{_noun}
        | {_gap}\s+(?:is|was|stays|remains|will\s+be)\s+(?:about\s+|roughly\s+)?
          as\s+(?:wide|long|large|great)\s+as\s+{_article}\s+{_noun}
        | (?:as\s+far\s+as|(?:further|farther|closer|nearer|more|less)\s+than)\s+(?:{_article}\s+)?
          {_noun}\s+is\s+(?:wide|long|tall|broad)
        | an?\s+{_noun}\s+apart
        | {_measure}\s+an?\s+{_noun}\s+away
    )\b""",
    re.VERBOSE | re.IGNORECASE,
)
