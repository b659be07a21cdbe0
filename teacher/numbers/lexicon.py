"""Word lists of the number detection, not yet normalized (see `normalization.normalize_word`)."""

from __future__ import annotations


def _words(text: str) -> tuple[str, ...]:
    return tuple(text.split())


def _set(text: str) -> frozenset[str]:
    return frozenset(text.split())


UNITS_AND_TEENS = _words(
    "zero nought naught nil two three four five six seven eight nine ten eleven twelve thirteen "
    "fourteen fifteen sixteen seventeen eighteen nineteen"
)
TENS = _words("twenty thirty forty fourty fifty sixty seventy eighty ninety ninty")
SCALES = _words("hundred thousand million billion trillion zillion gazillion bazillion googol")
CARDINALS = (*UNITS_AND_TEENS, *TENS, *SCALES)
"""English cardinals except "one", which has its own rule."""

ORDINALS = _words(
    "second third fourth fifth sixth seventh eighth eigth ninth nineth tenth eleventh twelfth "
    "twelth thirteenth fourteenth fifteenth sixteenth seventeenth eighteenth nineteenth twentieth "
    "thirtieth fortieth fourtieth fiftieth sixtieth seventieth eightieth ninetieth hundredth "
    "thousandth millionth billionth trillionth umpteenth nth kth ith jth zeroth tertiary secondly "
    "thirdly fourthly fifthly"
)
"""English ordinals except "first", which has its own rule."""

QUANTITIES = _words(
    "half halves halved halving halfway quarter quarters quartered thirds fourths fifths sixths "
    "sevenths eighths ninths tenths hundredths thousandths twice thrice double doubles doubled "
    "doubling doubly triple triples tripled tripling triply treble trebled quadruple quadruples "
    "quadrupled quintuple quintupled sextuple septuple octuple onefold dozen dozens dozenth "
    "couple couples duo trio triad triads triplet triplets umpteen quartet quintet sextet septet "
    "octet twain single singly percent percentage percentages percentile pct permille cent cents "
    "fortnight decade decades century centuries millennium millennia oclock teens zeroes onehalf"
)

TIMES = _words(
    "seconds millisecond milliseconds microsecond microseconds nanosecond nanoseconds sec secs "
    "msec msecs fps minutes mins hour hours hrs"
)
"""Words that measure time and therefore always state a number."""

MISSPELT = _words(
    "tre thre threee fower fiv sevn sevin seaven eigth eihgt nien tweleve eleve twelv thirten "
    "thirtean fiften seventen twentey hunderd hundrad thousend secound secnd thrid fith fourht"
)
FOREIGN = _words("""
uno dos tres cuatro cinco seis siete ocho nueve diez doce quince dieciséis diecisiete dieciocho
diecinueve veinte veintiuno veintidós treinta cuarenta cincuenta sesenta setenta ochenta noventa
cien ciento doscientos doscientas mil segundo segunda segundos segundas tercer tercero tercera
terceros cuarto cuarta quinto quinta séptimo décimo mitad doble dobles triple docena docenas
tercio tercios
deux trois quatre cinq sept huit neuf dix onze douze treize quatorze quinze vingt trente quarante
cinquante soixante mille moitié demi demie deuxième deuxièmes seconde secondes troisième quatrième
cinquième sixième quart quarts douzaine dizaine centaine
eins zwei zwo drei dreien vier fünf sechs sieben acht neun zehn zwölf dreizehn vierzehn fünfzehn
zwanzig dreißig vierzig fünfzig hundert tausend zweite zweiten zweiter zweites zweitem dritte
dritten dritter drittes drittem vierte vierten vierter fünfte fünften zweimal dreimal viermal
fünfmal zehnmal zweifach dreifach hälfte halb halbe halben halber halbes doppelt doppelte
doppelten dutzend drittel viertel sekunde sekunden stunde stunden prozent
quattro cinque sei sette otto nove dieci undici dodici tredici quindici venti trenta quaranta
cinquanta cento mila secondi seconda terzo terza terzi quarta quinta doppio doppia mezza dozzina
dois duas três quatro cinco sete oito dez doze vinte trinta cem segundo terceiro terceira quarto
metade meia dobro dúzia
twee drie vijf zeven negen tien twaalf dertien veertien vijftien twintig dertig veertig vijftig
honderd duizend tweede derde vierde vijfde helft halve dubbele tweemaal driemaal dozijn seconden
procent
två tre fyra sju åtta nio tio
dwa trzy cztery pięć sześć siedem osiem dziewięć dziesięć
bir iki dört beş altı yedi sekiz dokuz
dua tiga empat lima enam tujuh delapan sembilan sepuluh
ichi roku hachi juu futatsu mittsu yottsu
один два две двух двум двумя двое три трёх трём тремя трое четыре четырёх четырём пять пяти пятью
шесть шести семь семи восемь восьми девять десять десяти одиннадцать двенадцать двадцать тридцать
сорок пятьдесят сто двести тысяча тысячи тысяч половина половину половины дважды трижды вдвое
втрое второй вторая второе второго второму вторым втором вторую третий третья третье третьего
третьем третью четвёртый четвёртая пятый пятая десятый десятая треть четверть секунда секунду
секунды секунд минуты минут процентов дюжина
δύο τρία τρεις τέσσερα τέσσερις πέντε έξι επτά οκτώ εννέα δέκα
واحد واحدة اثنان اثنين اثنتان اثنتين ثلاثة ثلاث أربعة أربع خمسة خمس ستة ست سبعة سبع ثمانية ثماني
ثمان تسعة تسع عشرة عشر عشرون عشرين مئة مائة ألف مرتين نصف ثلث ربع ثاني ثانية ثالث ثالثة رابع رابعة
كرتان كرتين مكعبان مكعبين أسطوانتان أسطوانتين
दो तीन चार पांच पाँच छह छः सात आठ नौ दस ग्यारह बारह बीस सौ हज़ार दूसरा दूसरी तीसरा तीसरी तीसरे
चौथा चौथी आधा आधी आधे दोगुना दोगुनी पहला पहली
하나 둘 셋 넷 다섯 여섯 일곱 여덟 아홉 열 두개 세개 두 세 번째 절반
שתיים שניים שני שתי שלוש שלושה ארבע ארבעה חמש חמישה שבע שמונה תשע עשר
""")
"""Numbers in other languages that are not English words."""
FOREIGN_FIRSTS = _words(
    "primera primero primeras primeros premier première primeiro primeira primo erste ersten "
    "erster erstes erstem eerste первый первая первое первого первому первым первом первую"
)
"""Words that share the rule of "first"."""
NAMES = _set("otto dix tio tre bir mille mila lima")
"""Foreign numbers that are names when capitalized."""
ARABIC_PREFIXES = "(?:[وفبلك]|ال|لل)+"
"""Articles and prepositions that Arabic joins to the next word."""
IDIOMS = _words("""
两者 雙方 双方 一起 一样 一樣 一致 一直 一旦 一边 一邊 一方 一定 一般 一些 一緒 一瞬 一同 統一
统一 万一 十分 半径 半徑 三角 六面
""")
"""Ideographic words that contain a numeral but count nothing."""
UNSPACED = _words("ひとつ ふたつ みっつ よっつ いつつ むっつ ななつ やっつ ここのつ สอง สาม")
"""Numbers in scripts without spaces, detected inside longer text."""

IDEOGRAPHS = set("两兩半倍双雙")
"""Ideographs that count although Unicode gives them no numeric value."""
PICTOGRAPHS = {
    *(chr(c) for c in range(0x1F550, 0x1F568)),  # clock faces
    *(chr(c) for c in range(0x2680, 0x2686)),  # dice
    *(chr(c) for c in range(0x1F030, 0x1F0F6)),  # dominoes and playing cards
    *"🔟💯🔢🥇🥈🥉\u283c",
}

SUFFIXES = _words(
    "x s fold some ish way ways pack time times th ths sided dimensional ball balls sphere "
    "spheres cube cubes cylinder cylinders object objects frame frames second pair body"
)
"""Suffixes with which a number word still states a number ("threefold", "tenx")."""

ROMAN = _set(
    "ii iii iv vi vii viii ix xi xii xiii xiv xv xvi xvii xviii xix xx xxi xxii xxiii xxiv xxv "
    "xxx xl"
)
ITALIAN = _set(
    "le gli di ci sono con tra fra dei delle colpisce ogni sue suoi altri altre questi queste la "
    "alla sfere cubi cilindri oggetti palle palline volte corpi collisioni urti rimbalzi pezzi "
    "terzi metri fotogrammi del della dell e"
)
"""Words beside which "due" and "metà" are Italian."""
ENUMERATED = _set(
    "act case chapter class event figure item level mark no number object option part phase point "
    "scene section stage step type volume candidate sphere cube cylinder ball collision fig nr "
    "vol ch"
)
"""Nouns after which a single I, V or X is a numeral; candidates have the letters A to D only."""

UNITS = _set(
    "frame step timestep tick pixel px unit millimeter millimetre centimeter centimetre meter "
    "metre kilometer kilometre inch mile degree radian moment instant beat day week month year "
    "diameter radius width length"
)
PLURAL_UNITS = _set(
    "frames steps timesteps ticks pixels px units millimeters millimetres centimeters centimetres "
    "meters metres kilometers kilometres inches feet miles degrees radians moments instants beats "
    "times diameters radii widths lengths days weeks months years"
)
"""Units that a vague quantity such as "a few" counts."""
LENGTHS = _set(
    "pixel millimeter millimetre centimeter centimetre meter metre kilometer kilometre inch mile"
)
"""Units of length that "a" counts."""
VAGUE = _set(
    "few several many some numerous multiple handful countless various couple dozens tens lots"
)
FILLERS = _set(
    "of more the further additional short brief video extra tiny full whole remaining next last "
    "following body ball sphere cube cylinder object image"
)
"""Words between a vague quantity and its unit."""

NOUNS = _set(
    "sphere spheres cube cubes cylinder cylinders ball balls block object objects thing collision "
    "contact event frame step metal rubber gray grey red blue green brown cyan purple yellow "
    "region candidate image option scene pair bounce hit strike time moving stationary more "
    "quarter third tenth fifth hundred thousand million dozen unit pixel corner edge wall"
)
"""Words that "one" counts even after "the" or an adjective."""
ADJECTIVES = _set(
    "the this that which other another each every no any such either neither whichever whatever "
    "gray grey red blue green brown cyan purple yellow metal rubber metallic left right top "
    "bottom upper lower inner outer middle central near far fast slow quick heavy light large "
    "small big little tall round same correct wrong right true best next last final previous "
    "still stationary visible hidden nearby distant lone remaining new old good likely rear front "
    "back matte shiny dark bright mobile free different similar"
)
"""Words after which "one" is a pronoun, besides words in -er, -est, -ed and -ing."""
MODALS = _set("would can could might may should must will expects sees wonders")
NOT_ADJECTIVES = _set(
    "almost after under over either during being cylinder corner center together however whether "
    "only exactly least about more less fewer"
)
CLAUSE_OPENERS = _set(
    "it its the a an this that these those they their he she both each all any some no nothing "
    "everything contact motion struck hit gone past inside out free clear at there either neither "
    "gray grey red blue green brown cyan purple yellow we you i fully completely finally entirely "
    "already under behind hidden"
)
"""Words before which "once" is a conjunction, besides words in -ed and -ing."""
EXACTLY = _set("only just exactly than least most but even")
"""Words after which "once" counts."""
EVENTS = _set(
    "collision collisions contact contacts impact impacts bounce bounces hit hits strike strikes "
    "event events encounter encounters crash crashes"
)
BEFORE_MINUTE = _set("per each every next last final full whole another")
"""Words after which "minute" is a time, not a size."""
AFTER_MINUTE = _set(
    "later earlier ago or of after before passes passed pass elapses elapsed goes went has long"
)
"""Words before which "minute" is a time."""
TIME_PREPOSITIONS = _set(
    "in within after for about per than under over by every takes lasts took lasted around "
    "roughly almost nearly until before"
)
"""Words after which "a minute" is a time, unless it describes the next word."""
SCENE = (
    *_words("spheres cubes cylinders balls blocks objects candidates regions frames steps"),
    *_words("sphere cube cylinder ball block object candidate region frame step collision"),
    *_words("collisions bounce bounces contact contacts hit hits impact impacts scene shapes"),
    *_words("metal rubber gray grey red blue green brown cyan purple yellow moving body pair"),
)
"""Words that a number may be joined with ("tworedspheres")."""
NOT_ROMAN = _set("mix div dix di mi ci li cv cli dvi mlx xml")
PIECES = _set(
    "a i for do on no to so he mill trip sing coup thou sand red led let tri sec sect min ion and "
    "per cent way me ho fort fin sex sept oct cub dec ad half minute hour th ten d c b s o"
)
"""Ordinary words and letters that spell a number when joined."""
