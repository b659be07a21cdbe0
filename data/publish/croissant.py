"""An export described in Croissant 1.0 (MLCommons, JSON-LD): its files with their hashes, and the
record sets that they hold, field by field."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from data.publish.columns import MEANING
from data.store import Store

if TYPE_CHECKING:
    from datasets import Features

    from data.export import Shard

CONFORMS_TO = "http://mlcommons.org/croissant/1.0"
PARQUET = "application/x-parquet"
KEYS = {
    "selection": ("item_id",),
    "retrieval": ("query_id",),
    "database": ("database", "scene_id", "frame"),
}
"""The columns whose values name a row."""
KINDS = {"string": "sc:Text", "int64": "sc:Integer", "float64": "sc:Float", "bool": "sc:Boolean"}

CONTEXT = {
    "@language": "en",
    "@vocab": "https://schema.org/",
    "sc": "https://schema.org/",
    "cr": "http://mlcommons.org/croissant/",
    "rai": "http://mlcommons.org/croissant/RAI/",
    "dct": "http://purl.org/dc/terms/",
    "conformsTo": "dct:conformsTo",
    "data": {"@id": "cr:data", "@type": "@json"},
    "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
    "examples": {"@id": "cr:examples", "@type": "@json"},
    **{
        name: f"cr:{name}"
        for name in (
            "citeAs", "column", "equivalentProperty", "extract", "field", "fileObject",
            "fileProperty", "fileSet", "format", "includes", "isLiveDataset", "jsonPath", "key",
            "md5", "parentField", "path", "recordSet", "references", "regex", "repeated",
            "replace", "samplingRate", "separator", "source", "subField", "transform",
        )
    },
}  # fmt: skip
"""The vocabulary's own, as its specification gives it."""


def text(
    store: Store, columns: dict[str, Features], shards: Sequence[Shard], plan: dict[str, Any]
) -> str:
    """croissant.json of the export that `plan` describes, written as `shards`."""
    configurations = dict.fromkeys(s.configuration for s in shards)
    published = {"url": plan["url"], "datePublished": plan["published"]}
    described = {
        "@context": CONTEXT,
        "@type": "sc:Dataset",
        "name": f"dynapix-{store.name}",
        "description": (
            "Simulated collision scenes, and questions about their exact future frame: four "
            "candidates to choose from, and a database to retrieve from."
        ),
        "conformsTo": CONFORMS_TO,
        "license": "https://spdx.org/licenses/Apache-2.0.html",
        "creator": {"@type": "sc:Organization", "name": "DynaPix"},
        **{name: value for name, value in published.items() if value},
        # Nothing tells which of two builds came first: the store's identity tells them apart.
        "version": f"1.0.0+{store.identity}",
        "keywords": ["physics", "simulation", "video", "future frame", "image retrieval"],
        "inLanguage": "en",
        "distribution": [
            *(_file(s) for s in shards),
            *(_file_set(name) for name in configurations),
        ],
        "recordSet": [_record_set(name, columns[name]) for name in configurations],
    }
    return json.dumps(described, indent=1) + "\n"


def _file(shard: Shard) -> dict[str, Any]:
    return {
        "@type": "cr:FileObject",
        "@id": shard.path,
        "name": shard.path,
        "contentUrl": shard.path,
        "contentSize": f"{shard.bytes} B",
        "encodingFormat": PARQUET,
        "sha256": shard.sha256,
    }


def _file_set(configuration: str) -> dict[str, Any]:
    return {
        "@type": "cr:FileSet",
        "@id": f"{configuration}-files",
        "name": f"{configuration}-files",
        "encodingFormat": PARQUET,
        "includes": f"{configuration}/*.parquet",
    }


def _record_set(configuration: str, kinds: Features) -> dict[str, Any]:
    return {
        "@type": "cr:RecordSet",
        "@id": configuration,
        "name": configuration,
        "key": [{"@id": f"{configuration}/{column}"} for column in KEYS[configuration]],
        "field": [_field(configuration, column, (), kind) for column, kind in kinds.items()],
    }


def _field(configuration: str, column: str, inner: tuple[str, ...], kind: Any) -> dict[str, Any]:
    """The field of a column, or of the value `inner` that its structures hold under that name."""
    from datasets import Image, List

    described: dict[str, Any] = {
        "@type": "cr:Field",
        "@id": "/".join((configuration, column, *inner)),
        "name": "/".join((column, *inner)),
        "description": MEANING[inner[-1] if inner else column],
    }
    if isinstance(kind, List):
        described["repeated"] = True
        kind = kind.feature
    if isinstance(kind, dict):
        described["subField"] = [
            _field(configuration, column, (*inner, name), below) for name, below in kind.items()
        ]
        return described
    path = (*inner, "bytes") if isinstance(kind, Image) else inner
    described["dataType"] = "sc:ImageObject" if isinstance(kind, Image) else KINDS[kind.dtype]
    described["source"] = {
        "fileSet": {"@id": f"{configuration}-files"},
        "extract": {"column": column},
        **({"transform": {"jsonPath": ".".join(path)}} if path else {}),
    }
    return described
