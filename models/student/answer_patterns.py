"""The words and forms by which a model's response states, corrects or refuses an answer."""

from __future__ import annotations

import re


def _compile(pattern: str) -> re.Pattern[str]:
    """Compile a pattern without regard to case, in which "~" stands for white space."""
    return re.compile(pattern.replace("~", r"\s{1,9}"), re.IGNORECASE)


# The head of a statement: the words that announce a letter.
NOUN = (
    r"(?:option|candidate|image|choice|frame|letter|picture|panel|photo|figure|scene|number|answer)"
)
REVISED = r"(?:revised|corrected|updated|new|real|true|actual)"
OWN = (
    rf"(?:(?:{REVISED}|final|correct|best|right|top|forced|own|single|likely|closest|chosen|selected)"
    r"[\s_]+)"
)
FOREIGN = (
    r"(?:答案|正解|答え|回答|정답|réponse|respuesta|antwort|ответ|risposta|resposta|odpowiedź|"
    r"cevap|jawaban|đáp~án)(?:~\w+)?"
)
IS = (
    r"(?:\b(?:is|are|was|remains?|becomes?|lautet|est|es|ist|è"
    r"|(?:would|should|must|will|has~to|have~to|would~have~to|seems~to|appears~to)~be)\b"
    r"|是|为|は|은|는)"
)
HEAD = _compile(
    rf"(?:\b(?:{OWN}{{0,4}}(?:answer|ans|choice|final|pick|selection|selected|verdict|conclusion|"
    rf"guess|output|result|decision|target(?:~(?:frame|image))?)|{OWN}{{1,4}}(?:match|fit|{NOUN}))"
    rf"\b|{FOREIGN})[*_`]*"
    r"(?:\s?\([^()\n]{0,60}\)|,[^,:\n]{1,60},"
    r"|~(?:to|for|of|in|here|by|with|based|among|i|one)\b[^.:;?!=\n]{0,60}?){0,2}"
    rf"[*_`]*\s{{0,3}}(?:{IS}\s{{0,3}}:?|[:=]|[-–—/]>?(?!\w)|\.{{1,9}}(?=\s?\w\b)|=>)"
    r"|\b(?:(?:i|we)(?:'d|'ll|~(?:would|will|must|should|have~to|had~to|therefore|thus)){0,3}|let's)"
    r"~(?:choose|chose|pick|select|go(?:~with)?|opt~for|vote(?:~for)?|settle~on|answer(?:~with)?)\b"
    r"\s{0,3}:?|(?:^\W*|\b(?:i|we)(?:'m|'ve|~am|~are|~have)~)(?:choosing|selecting|picking|"
    r"going~with|chosen|selected|picked)\b(?=[^.;]{0,20}\b[A-D]\b(?:\W*$|\W*(?:as|because|since)\b))"
    r"|^\W*most~likely\s?:"
    rf"|^\W*match\s?:(?=\W*(?:{NOUN}~)?[A-D]\W*$)|\bi(?:'d|~would)~say\b"
    r"|\bchang(?:e|ed|ing)~(?:my~answer|my~choice|it|that)~to\b"
    r"|(?<!候)[选選](?![项項](?!\s*(?:是|为|:|[A-D]\W*$)))(?:择|択)?\s{0,3}:?"
)
HEADING = _compile(rf"^[\s*_#>-]*(?:the~|my~)?{OWN}{{0,4}}(?:answer|choice)[\s*_#:`]*$")
# What makes a later record or statement replace an earlier one.
CORRECTING = _compile(
    rf"\b(?:{REVISED}|actually|instead|reflection|second~thought|after~all|chang\w+|must|forced|"
    r"wait|correction|mistake|error|meant|sorry|let~me)\b"
)
REVISING = _compile(rf"\b(?:{REVISED}|actually|instead|on~reflection|after~all|chang\w+|must)\b")
REOPENING = _compile(
    r"\W*(?:(?:hmm+|no|oh)\W{1,3})?(?:wait|let~me~(?:double[- ]?check|re-?check|re-?examine)|"
    r"scratch~that|on~second~thought|on~reflection|let~me~correct|correction)\b"
)
CORRECTED = _compile(
    r"^\W*(?:(?:oh|hmm+|wait|no|nope|sorry|actually|maybe|rather|instead|correction|edit|i~meant?|"
    r"make~(?:it|that)|scratch~that|on~(?:second~thought|reflection)|my~mistake)\b\W*)+"
    r"(?:(?:it|that|this|the|my|is|it's|must|should|be|answer|choice|correct|final|i|choose|pick|"
    rf"say)\b\W*)*(?:{NOUN}\W*)?(?P<letter>[A-D])\W*$"
)
# Words before a statement that is an example, a condition or somebody else's. A clause such as
# "Since the cube has not moved," is skipped, unless it names a source.
REPORTED = _compile(
    r"\b(?:some(?:one|body)?|others?|reader|people|they|he|she|you|your|whether|if|unless|suppose|"
    r"assuming|otherwise|wrote|writes|says|said|reads|caption|claim\w*|thinks|another|user|might|"
    r"could|may|seems?|tempt\w+|not|never|(?<!no )(?<!without a )doubt|such~as|e\.?g|"
    r"for~(?:example|instance)|example|format|template|instructions?|like~this|in~the~form|"
    r"(?:first|second|third|initial|previous|"
    r"earlier|original|other|alternative|naive|wrong|incorrect|next|no|any|every|each)~"
    rf"(?:guess|pick|selection|{NOUN}))(?=\W|$)|n't\b|^\W*had\b"
)
CAUSE = _compile(
    r"\W*(?:since|because|as|given|after|based~on|compared|unlike|considering|taking|from|thus|"
    r"though|although|while)\b[^:]*,~"
    r"(?=(?:(?:and|thus|therefore|hence|then)~)*(?:the|my|i|we|i'd|i'll)\b)"
)
SOURCE = _compile(
    r"\b(?:if|unless|suppos\w+|assum\w+|whether|otherwise|some(?:one|body)?|others?(?!~\w)|people|"
    r"he|she|reader|model|user|teacher|caption|wrote|written|sa(?:y|ys|id)|states?|stated|reads|"
    r"claim\w*|think\w*|argu\w+|example|instance|e\.?g|format|template|instructions?|question)\b"
)
OWN_WORDS = _compile(r"\b(?:requested|required|if~i~(?:must|have~to|had~to))\b")
# The value of a statement: what may stand between its head and its letter, and after the letter.
BEFORE_LETTER = (
    r"(?:(?:(?:i|we|it|this|that|the|is|it's|that's|must|has|have|be|to|should|would|i'd|say|think|"
    r"believe|guess|go|going|choose|pick|select|with|for|probably|possibly|maybe|perhaps|most|more|"
    r"likely|clearly|because|"
    r"definitely|certainly|surely|indeed|fits|matches|shows|which|therefore|thus|hence|so|now|"
    rf"simply|just|only|best|correct|right|final|closest|my|one|either|both|{NOUN})\b"
    r"|[^\x00-\x7f]{1,9})[\s:,.#=-]*){0,12}"
)
STATEMENT = _compile(
    rf"(?P<before>[\s\-•.:,=>#]*(?:[^,\d]{{1,60}},\s)??{BEFORE_LETTER})"
    r"(?P<letter>[a-z0-9])(?![a-z0-9_])(?!'\w)\s*(?P<rest>.*)$"
)
NAMING = _compile(rf"\b{NOUN}~$")
POSITION = _compile(
    r"\b(?:(?P<ordinal>first|second|third|fourth)~(?:image|picture|candidate|option|frame|panel|one)"
    r"|(?:image|picture|candidate|option|frame|panel)[ #]{1,2}(?:number~)?(?P<number>[1-4]))\b"
)
POSITION_ALONE = _compile(
    rf"\W*(?:it(?:'s|~is)~)?(?:the~)?{POSITION.pattern}(?:\W*$|~(?:best~)?(?:matches|fits)\b"
    r"|~(?:is|must~be)~(?:the~)?(?:answer|correct|right|best|match|closest|one)\b)"
)
ORDINALS = {"first": "A", "second": "B", "third": "C", "fourth": "D"}
AFTER_A = _compile(
    r"$|[^\w\s]|[^\x00-\x7f]|(?:or|and|vs|to|yes|no|because|since|as|due|which|that|where|if|shows?|"
    r"match\w*|fits?|is|was|seems|looks|agrees|with|near|at|in|on|by|xx)\b"
)
# Other letters: those that are named, alternatives, and reasons for which one is named.
NAMED = re.compile(
    r"(?<![a-zA-Z0-9_'])([B-HJ-Z]|A(?!\s+(?!(?:or|and|vs|to|is|as)\b)[a-z]))(?![\w'])"
)
AND_OR = _compile(
    r"(?:[\W_]|\bmost\b|或|和|また?は|또는|или|\b(?:or|and|oder|ou|vs|to|possibly|maybe|perhaps|likely|"
    rf"probably|clearly|definitely|also|either|both|but|the|{NOUN})\b)*"
)
ALONE = _compile(rf"(?:{AND_OR.pattern}(?<![\w'])[a-z0-9](?![\w'])){{1,4}}[\s.,;!?)。]*")
EXCUSE = _compile(
    r"\b(?:because|since|as|due|though|although|while|whereas|unlike|instead|rather|not|no|than|"
    r"second~(?:choice|best)|runner|followed|initial(?:ly)?|considered|at~first|alternative|"
    r"wrong|incorrect|earl(?:y|ier)|lat(?:e|er)|ruled?\sout|too|cannot|never|"
    r"neither|reject\w*|eliminat\w*|exclud\w*)\b|n't\b"
)
# What takes a letter back (SELF stands for it) or refuses to answer.
REASON = _compile(r"\W*(?:because|since|as|due|though|although|while)\b")
FALSE = r"(?:wrong|incorrect|false|impossible|rejected|excluded|eliminated|ruled~out|implausible)"
NOT = r"(?:not|never|cannot|can't|doesn't|isn't|won't|hardly)"
WITHDRAWAL = _compile(
    r"^\W*(?:(?:wait|but|so|no|oh|actually)\b\W*){0,3}(?:i~(?:think|believe)~)?"
    r"(?:which|this|that|it|that's|it's|SELF)\b"
    rf"\W*(?:\w+~){{0,2}}?(?:{FALSE}|{NOT}~(?:(?:be|quite|really)~)?(?:fit|match|work|hold|"
    r"follow|right|correct|true|valid|possible|plausible|it|the~answer))\b"
    r"(?!~(?:that|for|to~(?:tell|say|be))\b|[^.!?]{0,20}\b[A-D]\b)"
    rf"|^\W*(?:{FALSE}|not~(?!SELF\b|[A-D]\b)\w+)\W*$|no[,.]~none\b"
    r"|^\W*(?:(?:oh|ah|hmm+|wait|but|actually|well|sorry|no|nope)\b\W*)+$"
    r"|\b(?:i~doubt|so~i~thought|scratch~that|take~(?:it|that)~back|never~mind|"
    r"chang\w+~my~(?:answer|choice|mind)|"
    r"(?:disregard|ignore)~(?:that|this|it|my|the~(?:line|answer|letter|above))|typo|placeholder|"
    r"withdraw|retract)\b"
    rf"|\bSELF~(?:(?:is|was|must~be)~(?:\w+~)?(?:{FALSE}|{NOT})|"
    r"(?:cannot|can't|couldn't|could~not)~be)\b"
)
REFUSAL = _compile(
    r"^(?:none|null|n/?a|nil|no|neither|unknown|unsure|abstain|refused?|declined?|pass)\W*$"
    r"|(?:can\s?not|can't|unable~to|impossible~to|not~able~to|could~not)~(?:be~)?(?:reliably~)?"
    r"(?:determine|tell|answer|decide|choose|select|pick|identify|say|assist|help|comply)"
    r"|refuse~to|(?:not~enough|insufficient)~(?:information|evidence|data)"
    r"|\bnone~of\b|\bor~none\b|\bno~(?:correct|valid|suitable|clear)~\w+"
)
ASIDE = _compile(
    r"(?:determine|tell|decide|identify|say|information~to~\w+|see)~(?:you~)?(?:(?:much|more|"
    r"anything)~)?(?:about~)?(?:the(?!~(?:answer|letter|correct|right|best|match|future|next|"
    r"candidate|option|image|frame))|its?~\w+|how~(?!to)|whether~(?!th|it|[A-D]\b)|more~about)\b"
    r"|\bnone~of~the~(?!candidates|options|images|above|answers|choices|four|frames|pictures)"
    r"|\bno~clear~\w+~of\b"
)
OTHERS = _compile(r"\b(?:others?|remaining|rest)\b|(?<![\w'])[A-D](?![\w'])")
CONDITION = _compile(r"\W*(?:if|unless|provided)\b")
WEAK_REFUSAL = _compile(
    r"\bsorry\b|(?:hard~to|do(?:~not|n't))~(?:determine|tell|answer|decide|know|see)"
)
# Sentences without a head: those that speak for a letter, conclusions, and verdicts.
RIVAL = _compile(
    r"\b(?:i~meant~|(?:argue|case)~for~|(?:it|this|that|edit|correction)(?:(?:'s|~is|~must~be|~has~to~be|~should~be|"
    r"~(?:could|may|might)(?:~(?!not\b|never\b)\w+){0,3}?~be)~|\s?:\s?"
    r"(?:(?:could|may|might)(?:~(?!not\b)\w+){0,3}?~be~)?))"
    rf"(?:\w+~)?(?:the~)?(?:{NOUN}~)?(?P<said>[A-D])(?=\W*$|[,;])"
    r"|(?<![\w'])(?P<subject>[A-D]):?~(?:(?:also|still|best|clearly|most~\w+)~)?"
    r"(?:remains\W*$|(?:fits|matches|agrees|represents|aligns|wins|satisf\w+|shows~exactly)\b|"
    r"(?:is|seems|looks|appears)~(?:to~be~)?(?:(?:just|equally|also|as|more|most|the|a|far|"
    r"much|too)~){0,3}(?:likely|plausible|possible|probable|right|correct|better|best|closer|"
    r"closest|consistent|answer|match|one|what~i)\b"
    r"(?!~(?:only|if|about|until|of~the|alternative|(?:to~be~)?an?~(?:\w+~)?(?:frame|image|state)|"
    r"the~frame|intermediate|earlier|later)\b))"
)
CONTRAST = _compile(
    r"\w:?~(?:also~)?(?:fits|matches|agrees|(?:is|seems|looks)~(?:also~)?(?:plausible|possible))\b"
    r"(?![^.]*\b(?:equally|just~as|as~well|later|sure|decide|tell|know|exclude)\b)"
    r"[^.]*\b(?:but|yet|except|until|only|neither)\b"
)
CLAUSE = _compile(
    r"(?<!none )(?<!nothing )(?<!all )(?<!everything )\b(?:but|however)\b|;"
    r"|(?<=,)\s(?=(?:so|therefore|thus|hence|that)\b)|^\W*(?:between|of|among|without)\b[^,]*,"
)
TAIL = _compile(
    rf"(?:\W*\b(?:and|or)\b)?\W*\b(?:not|over|(?:rather~|instead~)(?:than|of))~(?:{NOUN}~)?[A-D]"
    r"(?:\W+(?:(?:or|and)~)?[A-D]\b)*\W*$|(?<=\b[A-D]\b),?~(?:because|since|as)\b.*$"
)
LEFT = _compile(
    rf"^\W*(?:everything|all)~(?:but|except)~(?:{NOUN}~)?(?P<drawn>[A-D])~(?:is|are)~{FALSE}"
)
AGAINST = _compile(
    r"\b(?:worst|least|unlike|(?:everything|all)~(?:but|except)|reject|exclude|eliminate|rules?~out|"
    r"so~far|if(?!~i~ha)|unless|first|prefix|observed|wrong)\b"
)
SUPERIOR = _compile(r"\b(?:better|best|correct|right|answer|closest)\b")
CONCESSION = _compile(r"\W*(?:while|although|though|even~though)\b")
CONCLUSION = _compile(
    r"\b(?:match|matches|image|one|frame|candidate|option|state|future|it|this|that|which|closest|"
    r"best)\b[^.:;\n]{0,40}?~(?:is|(?:must|has~to|would|should|can~only)~be)~"
    rf"(?:\w+~)?(?:the~)?(?:{NOUN}~)?(?P<said>[A-D])\W*$"
    r"|(?<![\w'])(?P<subject>[A-D])~(?:is|must~be|would~be|should~be)~(?:the|my)~"
    r"(?:one|only|correct|right|best|match|closest|answer|choice|pick|guess|target|"
    r"most~(?:likely|plausible|probable))\b"
)
# What the last sentence says without a statement: a letter at its end after words that draw a
# conclusion or point to it, the only candidate that does something, or a letter with a reason.
DRAWN = _compile(
    r"\b(?:therefore|thus|hence|(?<!if )so(?!~far)|overall|finally|elimination|conclusion|"
    r"leav(?:es|ing)|if~i~(?:had|have)~to~(?:guess|choose|pick|decide)|in~my~(?:opinion|view))\b"
    rf"(?:\W*(?:it|is|it's|must|be|the|us|with|only)\b)*\W*(?:{NOUN}~)?(?P<drawn>[A-D])"
    rf"(?:~it~is)?\W*$|,\W*(?:(?:it|is|it's|probably)\b\W*)*(?:{NOUN}~)?(?P<listed>[A-D])\W*$"
    rf"|:~{NOUN}~(?P<after>[A-D])\W*$"
)
ENDING = _compile(
    r"\b(?:that~of|(?:shown|seen|depicted|represented|given)~(?:in|by)|corresponds?~to|match(?:es|ing)"
    r"|consistent~with|agrees~with|looks?~like|favou?rs|prefer|lean(?:s|ing)?~towards?|points~to|"
    r"those~(?:in|of)|we~get|my~prediction~is"
    rf"|^\W*i(?:'d|~would)?~(?:think|believe|guess|expect))~(?:{NOUN}~)?(?P<said>[A-D])\W*$"
    rf"|\b(?:only|(?:none|nothing)~(?:but|except))~(?:{NOUN}~)?(?P<only>[A-D])"
    r"~(?!(?:is|are)~(?:missing|wrong|not)\b|lacks|misses|fails|contradicts|violates)[a-z]+"
    rf"|\bmakes~(?:{NOUN}~)?(?P<made>[A-D])~the~(?!least|worst|wrong)"
    rf"|^\W*(?:{NOUN}~)?(?P<first>[A-D])\b\W*(?:because|since|as|it~is|i~(?:think|believe|guess)|"
    r"clearly|definitely|obviously|final)\b"
)
VERDICT = _compile(rf"\W*(?:{NOUN}~)?(?P<letter>[A-D])\b[\s).,:=*_-]+(?P<verdict>\w.*)")
LISTED = _compile(r"(?<![\w'])([A-D])\b\W*((?:(?!(?<![\w'])[A-D]\b).){0,99})")
YES = _compile(r"\b(?:yes|match(?:es)?|fits|correct|right|true|best)\b")
NO = _compile(r"\b(?:no|not|wrong|incorrect|false|mismatch|reject\w*|too)\b|n't\b")
# Markup.
TAG = _compile(
    r"<(?P<tag>(?:final_?)?(?:answer|choice))(?:\s[^<>]{0,80})?>(?P<value>[^<>]{0,200})</(?P=tag)>"
)
SINGLE = re.compile(r"(?<![\w'])[a-zA-Z0-9](?![\w'])")
LIST_NUMBER = re.compile(r"^\s{0,9}\d{1,2}[.)]\s(?=\s{0,3}\S)", re.MULTILINE)
STRUCK = re.compile(r"~~[^~\n]*~~")
BOXED = re.compile(r"\\boxed\s?\{(?:\\\w{1,9}\s?\{)?\s?([A-D])\s?\}|<\|begin_of_box\|>\s?([A-D])\b")
LATEX = re.compile(r"\\(?:boxed|text(?:bf|rm|tt)?|math(?:bf|rm|tt)|displaystyle)(?![a-z])")
BRACKETED = re.compile(r"""[(\[{*_`"'<$]\s?([A-D])\s?[)\]}*_`"'>$]""")
YES_SIGN = re.compile(r"\b([A-D])[ :,.=)-]{0,3}[✅✓✔☑]")
NO_SIGN = re.compile(r"\b([A-D])[ :,.=)-]{0,3}[❌✗✘✖]")
SPLIT_CLAUSE = re.compile(
    r"\b([A-D]), \W*(?=(?:is|must|fits|matches|agrees|remains|seems|looks)\b)"
)
MARKUP = re.compile(r"[*_`\"()\[\]{}<>$\\]+|(?<!\w)'|'(?!\w)")
SENTENCE = re.compile(r"(?<=[.!?;])\s+|\n+")
