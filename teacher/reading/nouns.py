"""The words of noun phrases for objects and regions."""

from __future__ import annotations

from data.records import COLORS, MATERIALS, SHAPES

COLOR_WORDS = {**{c: c for c in COLORS}, "grey": "gray"}
MATERIAL_WORDS = {**{m: m for m in MATERIALS}, "metallic": "metal", "rubbery": "rubber"}
SHAPE_WORDS = {**{s: s for s in SHAPES}, "ball": "sphere", "block": "cube"}
SINGULARS = {
    **SHAPE_WORDS,
    **dict.fromkeys(("object", "one", "body", "item", "thing", "solid"), ""),
}
"""The shape that each noun states, "" for any shape."""
PLURALS = {**{f"{word}s": shape for word, shape in SHAPE_WORDS.items()}, "objects": ""}

ROWS = {"top": 0, "upper": 0, "bottom": 2, "lower": 2}
COLUMNS = {"left": 0, "right": 2}
MIDDLE = {"center", "centre", "middle", "central"}
PLACES = {"corner", "area", "region", "part", "portion", "zone", "section"}
"""Nouns that may follow the words of a region."""
SIDES = {"side", "edge", "border", "boundary"}
"""Nouns that make a side such as "left" coarse: the left side has three regions."""
RIGHT_ONES = {
    *("place", "places", "spot", "spots", "position", "positions", "location", "locations"),
    *("object", "objects", "layout", "candidate", "answer", "choice", "way", "order", "time"),
}
"""Nouns before which "right" does not mean a side."""
AT = {
    *("near", "at", "in", "on", "along", "by", "around", "within", "inside", "toward", "towards"),
    *("to", "into", "from", "onto"),
}
"""Prepositions before a region."""
WAYS = {"toward": "toward", "towards": "toward", "to": "into", "into": "into", "from": "from"}
"""Prepositions of a region that an object moves to, ends in or comes from."""
IMAGE = {"view", "scene", "image", "frame", "picture", "screen", "field"}
