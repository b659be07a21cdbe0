"""Reads the claims of a rationale with a grammar of short sentences, and compares them with the
predicates.

The steps are text -> tags -> claims -> verdicts. For "The red cube is near the left.":

1. `tagging` splits the text into tags, pieces with a category: "The red cube" (object), "is" (be),
   "near the left" (region), "." (stop). phrases.yaml describes the categories of most tags.
2. A reader goes through the tags of a sentence and calls its method `on_<tag>` for each, such as
   `on_region`. `SceneReader` reads about the scene, `CandidateReader` about the candidates. Their
   bases are in `reader` and, for the clauses of a sentence, in `clauses`.
3. The methods record claims. Here, the kind is "region", the subject "red metal cube" (if only
   one object is a red cube), and the value "near the left".
4. `claims` compares a claim with the predicates at the moment that the clause is about: the
   cut (the last frame that the predicates treat as observed), the target, or between them. The
   verdict is "supported", "contradicted", or "unknown" if the predicates do not tell.

Every word of a sentence must have a rule. A sentence with another word, or with words in an order
that no rule expects or that has several readings, is unreadable: it makes no claim but
"unreadable".
"""
