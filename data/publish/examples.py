"""Items and queries of a store as rows of a contact sheet."""

from __future__ import annotations

from data.publish.contact_sheets import Cell, Row
from data.records import LETTERS, FrameRef, RetrievalQuery, SelectionItem, sample_prefix_frames
from data.render.frame_cache import FrameReader
from data.store import Store
from data.tracks.retrieval.counterfactual import removal_displacement
from data.world.displacement import cross_scene_displacement

PREFIX_FRAMES = 4
"""Number of frames that represent a prefix on a sheet."""
AXES = {
    "framing": "framing {}",
    "gap": "gap {}",
    "horizon": "horizon {}",
    "group": "group {}",
    "window_family": "family {}",
    "difficulty": "{}",
}
"""Construction axes of selection items, and how a heading states the value of each."""


class ExampleRows:
    """Turns the items and queries of a store into rows of a contact sheet."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self._frames = FrameReader(store)

    def item(self, item: SelectionItem) -> Row:
        """Return the prefix and the candidates of a selection item, with the answer marked."""
        values = {name: getattr(item, name) for name in AXES}
        axes = [AXES[name].format(value) for name, value in values.items() if value is not None]
        details = [item.split, *axes, f"least displacement {item.min_displacement:.0f} px"]
        candidates = [self._candidate(item, k) for k in range(len(item.candidates))]
        return Row(item.item_id, ", ".join(details), item.question, self._prefix(item), candidates)

    def query(self, query: RetrievalQuery) -> Row:
        """Return the prefix, the target and the hard negatives of a future-state query."""
        target = self._cell(query.target, "target", _moment(query, query.target), is_answer=True)
        return Row(
            query.query_id,
            f"{query.split}, anchor {query.anchor}",
            query.question,
            self._prefix(query),
            [target, *(self._negative(query, frame) for frame in query.hard_negatives)],
        )

    def counterfactual(self, query: RetrievalQuery) -> Row:
        """Return the prefix, the target and the hard negatives of a counterfactual query.

        The first hard negative is the factual frame: the query's own scene at the target's moment.
        A ring marks the object that the counterfactual scene lacks.
        """
        scene, without = (self._store.scene(i) for i in (query.scene_id, query.target.scene_id))
        removed = [look.phrase for look in scene.objects].index(query.removed_object)
        factual, *negatives = query.hard_negatives
        shift = removal_displacement(scene, without, removed)[query.target.frame]
        moment = _moment(query, query.target)
        return Row(
            query.query_id,
            f"{query.split}, without the {query.removed_object}",
            query.question,
            self._prefix(query, removed),
            [
                self._cell(factual, "factual", f"others differ by {shift:.0f} px", ring_on=removed),
                self._cell(query.target, "target: without it", moment, is_answer=True),
                *(self._negative(query, frame) for frame in negatives),
            ],
        )

    def _prefix(
        self, record: SelectionItem | RetrievalQuery, ring_on: int | None = None
    ) -> list[Cell]:
        frames = sample_prefix_frames(record.prefix_start, record.prefix_stop, PREFIX_FRAMES)
        return [
            self._cell(FrameRef(record.scene_id, f), f"frame {f}", ring_on=ring_on) for f in frames
        ]

    def _candidate(self, item: SelectionItem, position: int) -> Cell:
        candidate = item.candidates[position]
        displacements = {
            LETTERS[k]: self._displacement(candidate, other)
            for k, other in enumerate(item.candidates)
            if k != position
        }
        nearest = min(displacements, key=displacements.get)
        return self._cell(
            candidate,
            f"{LETTERS[position]}: {candidate.source}",
            f"{_moment(item, candidate)}, {displacements[nearest]:.0f} px from {nearest}",
            is_answer=position == item.answer,
        )

    def _negative(self, query: RetrievalQuery, frame: FrameRef) -> Cell:
        away = f"{self._displacement(query.target, frame):.0f} px away"
        return self._cell(frame, "wrong time", f"{_moment(query, frame)}, {away}")

    def _cell(
        self,
        frame: FrameRef,
        *caption: str,
        is_answer: bool = False,
        ring_on: int | None = None,
    ) -> Cell:
        image, ring = self._frames.image(frame.scene_id, frame.frame), None
        if ring_on is not None:
            scene = self._store.scene(frame.scene_id)
            x, y = scene.image_positions[frame.frame, ring_on] / scene.image_size
            ring = (x * image.width, y * image.height)
        return Cell(image, caption, is_answer, ring)

    def _displacement(self, one: FrameRef, two: FrameRef) -> float:
        scenes = self._store.scene(one.scene_id), self._store.scene(two.scene_id)
        return cross_scene_displacement(scenes[0], one.frame, scenes[1], two.frame)


def _moment(record: SelectionItem | RetrievalQuery, frame: FrameRef) -> str:
    """Describe when a frame occurs: its index and its offset in frames from the end of the prefix.

    The offset is omitted unless the frame is of the record's scene or of its counterfactual scene.
    """
    own = frame.scene_id.partition("-without-")[0] == record.scene_id
    return f"frame {frame.frame}" + (f" ({frame.frame - record.prefix_stop:+d})" if own else "")
