"""The closed lists that `numbers` looks words up in, before folding (see `folding.fold`)."""

from __future__ import annotations


def _words(text: str) -> tuple[str, ...]:
    return tuple(text.split())


UNITS_AND_TEENS = _words(
    "zero nought naught nil two three four five six seven eight nine ten eleven twelve thirteen "
    "fourteen fifteen sixteen seventeen eighteen nineteen"
)
TENS = _words("twenty thirty forty fourty fifty sixty seventy eighty ninety ninty")
SCALES = _words("hundred thousand million billion trillion zillion gazillion bazillion googol")
CARDINALS = (*UNITS_AND_TEENS, *TENS, *SCALES)
"""Every English cardinal but "one", which has rules of its own."""

ORDINALS = _words(
    "second third fourth fifth sixth seventh eighth eigth ninth nineth tenth eleventh twelfth "
    "twelth thirteenth fourteenth fifteenth sixteenth seventeenth eighteenth nineteenth twentieth "
    "thirtieth fortieth fourtieth fiftieth sixtieth seventieth eightieth ninetieth hundredth "
    "thousandth millionth billionth trillionth umpteenth nth secondary tertiary secondly "
    "thirdly fourthly fifthly"
)
"""Every English ordinal but "first", which has rules of its own."""

QUANTITIES = _words(
    "half halves halved halving halfway quarter quarters quartered thirds fourths fifths sixths "
    "sevenths eighths ninths tenths hundredths thousandths twice thrice double doubles doubled "
    "doubling doubly triple triples tripled tripling triply treble trebled quadruple quadruples "
    "quadrupled quintuple quintupled sextuple septuple octuple onefold dozen dozens dozenth couple "
    "couples duo trio triad triads triplet triplets umpteen quartet quintet sextet septet octet "
    "twain single singly percent percentage "
    "percentages percentile permille cent cents fortnight decade decades century centuries "
    "millennium oclock"
)

TIMES = _words(
    "seconds millisecond milliseconds microsecond microseconds nanosecond nanoseconds sec secs "
    "msec msecs fps minutes mins hour hours hrs"
)
"""Words that measure time, and so state a number, wherever they stand."""

MISSPELT = "tre thre fower fiv sevn seventen eleve twelv thirten fiften twentey hunderd thousend"
FOREIGN = _words(f"""
{MISSPELT}
uno dos tres cuatro cinco seis siete ocho nueve diez veinte cien ciento mitad doble
deux trois quatre cinq sept huit neuf dix onze douze treize quinze vingt trente mille moitie demi
eins zwei zwo drei vier fünf sechs sieben acht neun zehn zwölf zwanzig dreißig hundert tausend
zweite zweiten dritte dritten hälfte doppelt zweimal dreimal
quattro cinque sei sette otto nove dieci venti cento metà
dois duas três quatro oito dez vinte metade
twee drie vijf zeven negen tien twintig honderd
två tre fyra sju åtta nio tio
dwa trzy cztery pięć sześć siedem osiem dziewięć dziesięć
bir iki üç dört beş altı yedi sekiz dokuz
dua tiga empat lima enam tujuh delapan sembilan sepuluh
ichi roku hachi juu
один два две три четыре пять шесть семь восемь девять десять двадцать сто тысяча половина дважды
второй вторая второе третий третья
δύο τρία τρεις τέσσερα πέντε έξι επτά οκτώ εννέα δέκα
واحد اثنان ثلاثة أربعة خمسة ستة سبعة ثمانية تسعة عشرة
एक दो तीन चार पांच पाँच छह सात आठ नौ दस
하나 둘 셋 넷 다섯 여섯 일곱 여덟 아홉 열 두개 세개
שתיים שניים שלוש ארבע חמש שבע שמונה תשע עשר
""")

IDEOGRAPHS = set("两兩半倍双雙")
"""Ideographs that count without being numerals; numerals have a numeric value in Unicode."""
PICTOGRAPHS = {
    *(chr(c) for c in range(0x1F550, 0x1F568)),  # clock faces
    *(chr(c) for c in range(0x2680, 0x2686)),  # dice
    *(chr(c) for c in range(0x1F030, 0x1F0F6)),  # dominoes and playing cards
    *"🔟💯🔢🥇🥈🥉\u283c",
}

SUFFIXES = _words(
    "x s fold some ish way ways pack time times th ths sided dimensional ball balls sphere spheres "
    "cube cubes cylinder cylinders object objects frame frames second pair body"
)
"""What a number word may be glued to and still state a number ("threefold", "tenx")."""

ROMAN = _words(
    "ii iii iv vi vii viii ix xi xii xiii xiv xv xvi xvii xviii xix xx xxi xxii xxiii xxiv xxv "
    "xxx xl"
)
ENUMERATED = _words(
    "act case chapter class event figure item level mark no number object option part phase point "
    "scene section stage step type volume candidate sphere cube cylinder ball collision"
)
"""Nouns after which a lone I, V or X is a numeral. Candidates go by A to D, so they count here."""

COUNTED = _words(
    "frame frames step steps timestep timesteps tick ticks pixel pixels px unit units centimeter "
    "centimeters centimetre centimetres meter meters metre metres inch inches feet degrees radians "
    "moment moments instant instants beat beats times"
)
"""Units that are counted as soon as a vague quantity such as "a few" stands before them."""
VAGUE = _words(
    "few several many some numerous multiple handful countless various couple dozens tens lots"
)

NOUNS = _words(
    "sphere spheres cube cubes cylinder cylinders ball balls block object objects thing collision "
    "contact event frame step metal rubber gray grey red blue green brown cyan purple yellow "
    "region candidate image option scene pair bounce hit strike time moving stationary more "
    "quarter third tenth fifth hundred thousand million dozen unit pixel corner edge wall"
)
"""Words that "one" counts even after "the" or an adjective."""
ADJECTIVES = _words(
    "the this that which other another each every no any such either neither whichever "
    "whatever gray grey red blue green brown cyan purple yellow metal rubber metallic left right "
    "top bottom upper lower inner outer middle central near far fast slow quick heavy light large "
    "small big little tall round same correct wrong right true best next last final previous still "
    "stationary visible hidden nearby distant lone remaining new old good likely rear front back "
    "matte shiny dark bright mobile free different similar"
)
"""Words after which "one" is a pronoun; so is it after words in -er, -est, -ed and -ing."""
MODALS = _words("would can could might may should must will expects sees wonders")
