"""Auxiliary heads that train the tiny base on what the oracle knows, and their losses.

The heads are discarded after the training. A text names a few objects; the heads are trained on
every visible object in every picture. They are linear, so the base itself has to represent what
they predict. They read

    "vision"       visual tokens, as the vision tower gives them: colour, material, shape, whether
                   the centre of an object is in the token, where in the token and in the image, and
                   the displacement between the two frames of the picture
    "object"       visual tokens after the layer `MIDDLE`: place, whether the object moves,
                   velocity, displacements ahead, and, in a candidate, displacement since the end of
                   the clip and the smallest distance between two of the object's places in this and
                   the earlier candidates
    "name_words"   names of objects in a text after the layer `MIDDLE`: colour, material and shape,
                   as in "vision", so that attention can compare a name with visual tokens
    "name"         names of objects in a text after the layer `NAMING`: in which pictures the object
                   is visible and where, its displacement up to the moment of the target, and how
                   far apart the candidates show it
    "description"  tokens from the end of a name until the text names another object, candidate or
                   section, or the sentence ends, after the layer `SPEAKING`: place and velocity of
                   the named object in the picture that the text describes there; if the text gives
                   its place relative to another object, its displacement from that object; and, in
                   a candidate, its displacement and distance from the expected place, and the
                   candidate's letter

A text attends to what earlier layers stored at the visual tokens, so static properties are trained
at the tower's output and motion in the middle layers. Attention heads are trained too (see
`research.tiny_base.trace`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor, nn
from torch.nn.functional import binary_cross_entropy_with_logits, cross_entropy, smooth_l1_loss

from dynapix.teacher.predicates.statement_choice import UNSEEN_DISTANCE
from research.tiny_base.oracle_targets import AHEAD, PICTURES, OracleTargets

AHEADS = tuple(f"ahead_{frames}" for frames in AHEAD)
DISPLACEMENTS = ("velocity", *AHEADS, "since")
SCALES = {"place": 6.0, "offset": 3.0, "error": 6.0, "inside": 1.0, "shift": 15.0} | dict.fromkeys(
    (*DISPLACEMENTS, "separation"), 5.0
)
"""Factors on places and displacements, so that their losses are of similar size."""
SMOOTH_L1_BETA = 0.1
"""Scaled error above which the loss of a place or displacement is linear."""
MOVING_SPEED = 0.012
"""An object moves if its velocity, as a share of the image in 10 frames, is above this.
Displacements ahead are measured for objects that move, `since` for objects that are displaced by
more than this."""


class OracleHeads(nn.Module):
    """The linear heads.

    Colours, materials and shapes have no heads of their own: the logit of a word is the product of
    the visual token and the word's embedding. A name in a text thus resembles the visual tokens of
    its object, and attention finds these.

    Args:
        embedding: The embedding of the language model's tokens. The vision tower's output has the
            same width.
        word_ids: Tokens of the words of each kind of `oracle_targets.WORDS`.
        letter_ids: Tokens of the letters of candidates.
    """

    def __init__(
        self,
        embedding: nn.Embedding,
        word_ids: Mapping[str, list[int]],
        letter_ids: Sequence[int],
    ) -> None:
        super().__init__()
        # In a tuple, the embedding is no submodule: the heads do not own it.
        self._embedding = (embedding,)
        self._word_ids = {kind: torch.tensor(ids) for kind, ids in word_ids.items()}
        self._letter_ids = torch.tensor(letter_ids)
        hidden = embedding.embedding_dim

        def heads(widths: Mapping[str, int]) -> nn.ModuleDict:
            return nn.ModuleDict({name: nn.Linear(hidden, n) for name, n in widths.items()})

        self.vision = heads({"presence": 1, "inside": 2, "shift": 2, "place": 2})
        self.object = heads(
            {"place": 2, "moving": 1, "separation": 1} | dict.fromkeys(DISPLACEMENTS, 2)
        )
        self.name = heads({"visible": PICTURES, "places": 2 * PICTURES, "future": 2})
        self.description = heads({"place": 2, "velocity": 2, "offset": 2, "error": 2})
        self.separation, self.distance = nn.Linear(hidden, 1), nn.Linear(hidden, 1)
        self.norms = nn.ModuleDict(
            {
                name: nn.LayerNorm(hidden)
                for name in ("vision", "object", "name_words", "name", "description")
            }
        )

    def vision_losses(self, tokens: Tensor, targets: OracleTargets) -> dict[str, Tensor]:
        """Return the losses of the vision tower's output at all visual tokens, (B, T, H)."""
        tokens = self.norms["vision"](tokens)
        row, token = targets.objects.T
        seen = tokens[row, token]
        presence = self.vision["presence"](tokens)[..., 0]
        losses = {"presence": 2 * binary_cross_entropy_with_logits(presence, targets.presence)}
        for kind, logits in self.word_logits(seen).items():
            losses[kind] = cross_entropy(logits, targets.truth[kind])
        truth = targets.truth | {"inside": targets.inside}
        for name in ("inside", "shift", "place"):
            losses[f"vision {name}"] = regression_loss(
                self.vision[name](seen), truth[name], SCALES[name]
            )
        return losses

    def word_logits(self, seen: Tensor) -> dict[str, Tensor]:
        """Return the logits of the words of each kind for normalised visual tokens, (N, H)."""
        weight = self._embedding[0].weight
        return {kind: seen @ weight[ids].T for kind, ids in self._word_ids.items()}

    def object_losses(self, hidden: Tensor, targets: OracleTargets) -> dict[str, Tensor]:
        """Return the losses at all visual tokens after the layer `MIDDLE`, (B, T, H)."""
        objects = self.norms["object"](hidden[targets.objects[:, 0], targets.objects[:, 1]])
        truth = targets.truth
        losses = {
            name: regression_loss(self.object[name](objects), truth[name], SCALES[name])
            for name in ("place", "separation", *DISPLACEMENTS)
        }
        observed = ~truth["velocity"][:, 0].isnan()
        if observed.any():
            moves = (truth["velocity"][observed].norm(dim=1) > MOVING_SPEED).float()
            moving = self.object["moving"](objects[observed])[:, 0]
            losses["moving"] = binary_cross_entropy_with_logits(moving, moves)
        return losses

    def measures(
        self, tokens: Tensor, hidden: Tensor | None, targets: OracleTargets
    ) -> dict[str, Tensor]:
        """Return the accuracies and errors of the heads of `vision_losses` and `object_losses`.

        Args:
            hidden: None leaves out what is read in the middle layers.

        Returns:
            `color`, `material` and `shape` (N,), whether the word is right; `moving` and, for
            moving objects, `heading` (one of eight), likewise; and errors as shares of the image:
            `place_error`, and `<displacement>_error` beside `<displacement>_still`, the error of
            predicting no displacement, of objects that are displaced.
        """
        truth = targets.truth
        row, token = targets.objects.T
        seen = self.norms["vision"](tokens)[row, token]
        words = self.word_logits(seen)
        found = {kind: logits.argmax(dim=-1) == truth[kind] for kind, logits in words.items()}
        moves = truth["velocity"].norm(dim=1) > MOVING_SPEED
        if hidden is None:
            shift = self.vision["shift"](seen)
            found["heading"] = (heading_octant(shift) == heading_octant(truth["velocity"]))[moves]
            return found
        objects = self.norms["object"](hidden[row, token])
        read = {
            name: self.object[name](objects).float() / SCALES[name]
            for name in SCALES
            if name in self.object
        }
        observed = ~truth["velocity"][:, 0].isnan()
        found["moving"] = ((self.object["moving"](objects)[:, 0] > 0) == moves)[observed]
        headings = [heading_octant(values["velocity"]) for values in (read, truth)]
        found["heading"] = (headings[0] == headings[1])[moves]
        found["place_error"] = (read["place"] - truth["place"]).norm(dim=1)
        for name in (*AHEADS, "since"):
            distances = truth[name].norm(dim=1)
            # Objects in images have no velocity, so `since` is filtered by its own length.
            displaced = distances > MOVING_SPEED
            if name != "since":
                displaced = moves & ~distances.isnan()
            found[f"{name}_error"] = (read[name] - truth[name]).norm(dim=1)[displaced]
            found[f"{name}_still"] = distances[displaced]
        return found

    def name_word_losses(self, hidden: Tensor, targets: OracleTargets) -> dict[str, Tensor]:
        """Return the losses at names in texts, from the output of the layer `MIDDLE`, (B, L, H)."""
        row, at = targets.names.T
        names = self.norms["name_words"](hidden[row, at])
        return {
            kind: cross_entropy(logits, targets.name_words[kind])
            for kind, logits in self.word_logits(names).items()
        }

    def name_losses(self, hidden: Tensor, targets: OracleTargets) -> dict[str, Tensor]:
        """Return the losses at names in texts, from the output of the layer `NAMING`, (B, L, H)."""
        row, at = targets.names.T
        names = self.norms["name"](hidden[row, at])
        pictures = targets.has_picture[row]
        visible = (targets.name_tokens >= 0).float()[pictures]
        separations = measure_separations(targets.name_places)[:, None]
        return {
            "visible": binary_cross_entropy_with_logits(
                self.name["visible"](names)[pictures], visible
            ),
            "places": regression_loss(
                self.name["places"](names), targets.name_places, SCALES["place"]
            ),
            "future": regression_loss(
                self.name["future"](names), targets.name_displacements, SCALES["since"]
            ),
            "separation": regression_loss(
                self.separation(names), separations, SCALES["separation"]
            ),
        }

    def description_losses(self, hidden: Tensor, targets: OracleTargets) -> dict[str, Tensor]:
        """Return the losses at the tokens that describe a named object, from the output of the
        layer `SPEAKING`, (B, L, H)."""
        row, at = targets.description_tokens.T
        described = self.norms["description"](hidden[row, at])
        truth = dict(zip(self.description, targets.description_states.split(2, dim=1), strict=True))
        losses = {
            name: regression_loss(head(described), truth[name], SCALES[name])
            for name, head in self.description.items()
        }
        distance = truth["error"].norm(dim=1, keepdim=True)
        losses["distance"] = regression_loss(self.distance(described), distance, SCALES["error"])
        letters = targets.description_letters
        if (letters >= 0).any():
            # A head that attends to the closest candidate thus finds the letter there.
            logits = described[letters >= 0] @ self._embedding[0].weight[self._letter_ids].T
            losses["letter"] = cross_entropy(logits, letters[letters >= 0])
        return losses


def regression_loss(predicted: Tensor, true: Tensor, scale: float) -> Tensor:
    """Return twice the mean smooth L1 loss between `predicted` and `true * scale`, without the
    elements that are NaN in `true`."""
    known = ~true.isnan()
    if not known.any():
        return predicted.sum() * 0
    return 2 * smooth_l1_loss(predicted[known], true[known] * scale, beta=SMOOTH_L1_BETA)


def measure_separations(places: Tensor) -> Tensor:
    """Return the separation (M,) of the places of objects in the candidates (see
    `teacher.predicates.statement_choice.measure_separation`); NaN if no candidate shows the object.

    Args:
        places: (M, 2 * PICTURES) places in the clip and in the candidates, NaN where the object is
            not visible.
    """
    candidates = places.unflatten(1, (-1, 2))[:, 1:]
    first, second = torch.combinations(torch.arange(candidates.shape[1])).T
    distances = (candidates[:, first] - candidates[:, second]).norm(dim=2)
    unseen = candidates.isnan().any(dim=2)
    neither = unseen[:, first] & unseen[:, second]
    distances = distances.nan_to_num(UNSEEN_DISTANCE).masked_fill(neither, 0)
    return distances.amin(dim=1).masked_fill(unseen.all(dim=1), torch.nan)


def heading_octant(vectors: Tensor) -> Tensor:
    """Return which of eight headings vectors (N, 2) have."""
    return torch.round(torch.atan2(vectors[:, 1], vectors[:, 0]) / (math.pi / 4)) % 8
