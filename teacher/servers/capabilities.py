"""What a server takes of a request, found out by a few tiny requests before the first real one.

A server may refuse an optional field or limit the number of responses to a request. It may also
ignore a constraint without saying so. The probe therefore asks for a text that no model would write
on its own, and looks whether it arrives.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from typing import Any

from dynapix.teacher.servers.responses import Response

Messages = list[dict[str, Any]]
"""A prompt in the chat format."""
RequestFields = dict[str, Any]
"""Fields of a chat completion request; those outside OpenAI's API are in `extra_body`."""
Constraint = str | dict[str, Any]
"""What responses are constrained to: a GBNF grammar (str) or a JSON schema (dict)."""
Ask = Callable[..., Awaitable[list[Response] | None]]
"""Sends the canary with fields in `extra_body`, a number of responses and a maximum length. Returns
the responses, or None if the server refuses this request but not the bare canary."""

CANARY: Messages = [{"role": "user", "content": "Say hello."}]
"""A prompt that any working server answers."""
OPTIONAL = ("top_k", "min_p", "repetition_penalty", "chat_template_kwargs", "mm_processor_kwargs")
"""Fields in `extra_body` without which a request still has a meaning."""
UNLIKELY = "xyzzy plugh"
UNLIKELY_GRAMMAR = f'root ::= "{UNLIKELY}"\n'
UNLIKELY_SCHEMA = {
    "type": "object", "properties": {"word": {"type": "string", "enum": [UNLIKELY]}},
    "required": ["word"], "additionalProperties": False,
}  # fmt: skip
"""Constraints that only a text with `UNLIKELY` meets."""
PROBE_TOKENS = 128
"""Maximum length of a constrained response to the probe. `UNLIKELY` may need a token per letter,
and a schema admits white space."""


@dataclass(frozen=True)
class Capabilities:
    """What a server takes.

    Attributes:
        refused: The fields of `extra_body` that it refuses.
        most: Maximum number of responses to a request; None if no request asks for several.
        form: The name under which it applies the constraint; None if it applies none.
    """

    refused: frozenset[str] = frozenset()
    most: int | None = None
    form: str | None = None

    def adapt(self, fields: RequestFields, constraint: Constraint | None) -> RequestFields:
        """Return the fields of a request without those that the server refuses, and with the
        constraint under the name that works."""
        extra = fields.get("extra_body", {})
        extra = {name: value for name, value in extra.items() if name not in self.refused}
        if constraint is not None and self.form is not None:
            extra |= constraint_forms(constraint)[self.form]
        return {**fields, "extra_body": extra}


def optional_fields(fields: RequestFields) -> RequestFields:
    """Return the fields in `extra_body` that a server may refuse."""
    return {k: v for k, v in fields.get("extra_body", {}).items() if k in OPTIONAL}


def constraint_forms(constraint: Constraint) -> dict[str, RequestFields]:
    """Return the fields that ask for a constraint, by the name under which servers know it. For a
    grammar: vLLM, llama.cpp and earlier versions of vLLM. For a JSON schema: OpenAI's API, which
    all of them have, and earlier versions of vLLM."""
    if isinstance(constraint, str):
        return {
            "structured_outputs": {"structured_outputs": {"grammar": constraint}},
            "grammar": {"grammar": constraint},
            "guided_grammar": {"guided_grammar": constraint},
        }
    schema = {"name": "response", "strict": True, "schema": constraint}
    return {
        "response_format": {"response_format": {"type": "json_schema", "json_schema": schema}},
        "guided_json": {"guided_json": constraint},
    }


async def find_capabilities(
    ask: Ask, fields: RequestFields, constraint: Constraint | None, samples: int
) -> Capabilities:
    """Probe a server.

    Args:
        fields: The fields of the requests to come.
        samples: Maximum number of responses to a request to come.
    """
    optional = optional_fields(fields)
    refused: set[str] = set()
    found = await ask(optional, samples)
    if found is None:
        refused = {k for k, v in optional.items() if await ask({k: v}, 1) is None}
        # The server gives `given` responses to a request, and does not give `too_many`.
        given, too_many, count = 1, samples + 1, samples
        while too_many - given > 1:
            if (answer := await ask({}, count)) is None:
                too_many = count
            else:
                given, found = count, answer
            count = (given + too_many) // 2
    most = (len(found) if found else 1) if samples > 1 else None
    for form, asked in constraint_forms(_unlikely(constraint)).items() if constraint else ():
        answer = await ask(asked, 1, PROBE_TOKENS)
        if answer and UNLIKELY in answer[0].text:
            return Capabilities(frozenset(refused), most, form)
    return Capabilities(frozenset(refused), most)


def _unlikely(constraint: Constraint) -> Constraint:
    return UNLIKELY_GRAMMAR if isinstance(constraint, str) else UNLIKELY_SCHEMA


def describe(
    found: Capabilities, fields: RequestFields, constraint: Constraint | None, samples: int
) -> str:
    """Return what a server takes in words, such as "takes top_k; refuses min_p, which ..."."""
    optional = optional_fields(fields)
    parts = []
    if taken := [name for name in optional if name not in found.refused]:
        parts.append(f"takes {', '.join(taken)}")
    if found.refused:
        parts.append(f"refuses {', '.join(sorted(found.refused))}, which requests leave out")
    if samples > 1:
        parts.append(f"gives up to {found.most} of {samples} responses to a request")
    if constraint is not None:
        kind = "grammar" if isinstance(constraint, str) else "JSON schema"
        parts.append(
            f"applies the {kind} as {found.form}"
            if found.form
            else f"does not apply the {kind} (constraint: none)"
        )
    return "; ".join(parts)
