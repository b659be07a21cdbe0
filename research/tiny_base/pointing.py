"""Losses that train attention heads of the tiny base to attend to given tokens."""

from __future__ import annotations

import torch
from torch import Tensor

from dynapix.data.records import LETTERS
from research.tiny_base.oracle_targets import PICTURES, OracleTargets
from research.tiny_base.trace import (
    CHOOSING,
    NAMING,
    PRECEDING,
    RECALLING,
    SPEAKING,
    TRACKING,
    Trace,
)


def pointing_losses(trace: Trace, targets: OracleTargets) -> dict[str, Tensor]:
    """Return the losses of attention heads: the negative logarithm of the attention weight from a
    token to the token that it should attend to.

    loss                layer, head    from -> to
    before              PRECEDING 0    token of a text -> the token before it
    second before       PRECEDING 1    token of a text -> the second token before it
    label               PRECEDING 2    visual token of a candidate -> its letter in the prompt
    track clip          TRACKING 0     object in a candidate -> the same object at the end of the
                                       clip
    track k             TRACKING 2+k   object in a candidate -> the same object in candidate k, an
                                       earlier one, or, if it does not show the object, the first
                                       token of the sequence
    letter              TRACKING 1     name in a text about a candidate -> the candidate's letter in
                                       the text
    find k              NAMING k       name -> the object in picture k, or, if the picture does not
                                       show it, the first token of the sequence
    find shown          NAMING 5       name -> likewise, in the picture that the text describes
    subject             RECALLING 0    token that describes an object -> the object's name
    repeat              RECALLING 1    token before a repeated name -> the name's last mention
    reference           RECALLING 2    token that describes the sphere in "the cube has the sphere
                                       left of it" -> the cube's name
    verdict             SPEAKING 0     token before a letter in an outcome -> "agrees" of this
                                       candidate, or its letter after "closest"
    next in clip        SPEAKING 1     token before a new name in a scene parse -> the object at the
                                       end of the clip
    next in candidates  SPEAKING 2     token before a name that is new in a text, or in its
                                       predictions -> the object in the last candidate that shows it
    match               SPEAKING 3     letter in a line that says whether a candidate matches ->
                                       the last letter in the outcome
    choice              CHOOSING 0     token before a letter after "closest" -> the last
                                       token about the object in this candidate

    The two preceding tokens allow later layers to find what followed an earlier use of the same
    words. The letters allow a text about a candidate to find the candidate's visual tokens.
    """
    losses = {}
    row, start, end = targets.tracked_to_clip.T
    if len(row):
        query, key = targets.visual[row, start], targets.visual[row, end]
        losses["track clip"] = -trace.log_attention(TRACKING, 0, row, query, key).mean()
    for k in range(len(LETTERS) - 1):
        row, start, _, end = targets.tracked_to_candidates[
            targets.tracked_to_candidates[:, 2] == k
        ].T
        if len(row):
            query, key = targets.visual[row, start], locate_objects(row, end, targets)
            weights = trace.log_attention(TRACKING, 2 + k, row, query, key)
            losses[f"track {k}"] = -weights.mean()
    for head in range(PICTURES):
        named = targets.has_picture[targets.names[:, 0], head]
        row, query = targets.names[named].T
        if len(row):
            key = locate_objects(row, targets.name_tokens[named, head], targets)
            losses[f"find {head}"] = -trace.log_attention(NAMING, head, row, query, key).mean()
    row, position = targets.text_tokens.T
    before, second_before = (torch.stack([row, position, position - k], dim=1) for k in (1, 2))
    row, query, token = targets.next_in_clip.T
    next_in_clip = torch.stack([row, query, targets.visual[row, token]], dim=1)
    row, query, token = targets.next_in_candidates.T
    next_in_candidates = torch.stack([row, query, targets.visual[row, token]], dim=1)
    row, query, token = targets.described_tokens.T
    shown = torch.stack([row, query, locate_objects(row, token, targets)], dim=1)
    for name, layer, head, pairs in (
        ("before", PRECEDING, 0, before),
        ("second before", PRECEDING, 1, second_before),
        ("label", PRECEDING, 2, targets.prompt_letters),
        ("letter", TRACKING, 1, targets.text_letters),
        ("find shown", NAMING, PICTURES, shown),
        ("subject", RECALLING, 0, targets.subjects),
        ("repeat", RECALLING, 1, targets.repeats),
        ("reference", RECALLING, 2, targets.references),
        ("verdict", SPEAKING, 0, targets.verdicts),
        ("choice", CHOOSING, 0, targets.choices),
        ("next in clip", SPEAKING, 1, next_in_clip),
        ("next in candidates", SPEAKING, 2, next_in_candidates),
        ("match", SPEAKING, 3, targets.matches),
    ):
        row, query, key = pairs.T
        if len(row):
            losses[name] = -trace.log_attention(layer, head, row, query, key).mean()
    return losses


def locate_objects(row: Tensor, token: Tensor, targets: OracleTargets) -> Tensor:
    """Return the positions of visual tokens in the sequence, and that of its first token for -1."""
    return targets.visual[row, token].where(token >= 0, targets.start[row])
