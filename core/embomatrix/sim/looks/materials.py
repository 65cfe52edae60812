"""Materials of pictures: colour, pattern, gloss and glow."""

from dataclasses import dataclass
from enum import StrEnum
from typing import Final

Rgb = tuple[float, float, float]


class Pattern(StrEnum):
    """Texture of a material. `patterns` draws one tile for each."""

    PLAIN = "plain"
    GRAIN = "grain"
    PLANKS = "planks"
    TILES = "tiles"
    CARPET = "carpet"
    WEAVE = "weave"
    RUG = "rug"
    BRUSHED = "brushed"
    STONE = "stone"
    PLASTER = "plaster"
    LEAVES = "leaves"
    GRASS = "grass"
    SKIN = "skin"
    CRUMB = "crumb"
    LABEL = "label"
    PANEL = "panel"
    PICTURE = "picture"
    SCREEN = "screen"


class MaterialKind(StrEnum):
    """Key of ``MATERIALS``."""

    # structure
    OAK = "oak"
    WALNUT = "walnut"
    PINE = "pine"
    BAMBOO = "bamboo"
    LACQUER = "lacquer"
    STEEL = "steel"
    IRON = "iron"
    BRASS = "brass"
    COPPER = "copper"
    ALUMINIUM = "aluminium"
    PORCELAIN = "porcelain"
    STONEWARE = "stoneware"
    TERRACOTTA = "terracotta"
    GLASS = "glass"
    MIRROR = "mirror"
    GRANITE = "granite"
    STONE = "stone"
    PLASTER = "plaster"
    WHITE_PLASTIC = "white plastic"
    BLACK_PLASTIC = "black plastic"
    PLASTIC = "plastic"
    RUBBER = "rubber"
    SCREEN = "screen"
    PICTURE = "picture"
    LAMPSHADE = "lampshade"
    LIGHT = "light"
    WAX = "wax"
    # cloth and paper
    UPHOLSTERY = "upholstery"
    LINEN = "linen"
    TEXTILE = "textile"
    TOWEL = "towel"
    RUG = "rug"
    LEATHER = "leather"
    WICKER = "wicker"
    FUR = "fur"
    PAPER = "paper"
    CARDBOARD = "cardboard"
    BOOK = "book"
    PACKAGE = "package"
    BOTTLE = "bottle"
    JAR = "jar"
    TIN = "tin"
    SACK = "sack"
    # plants and ground
    FOLIAGE = "foliage"
    LAWN = "lawn"
    BARK = "bark"
    SOIL = "soil"
    SAND = "sand"
    WATER = "water"
    FLOWER = "flower"
    # food
    LEAFY = "leafy green"
    GREEN = "green fruit"
    RED = "red fruit"
    ORANGE = "orange fruit"
    YELLOW = "yellow fruit"
    PURPLE = "purple fruit"
    BROWN = "brown fruit"
    PINK = "pink"
    MUSHROOM = "mushroom"
    ROOT = "root"
    BREAD = "bread"
    DOUGH = "dough"
    CHOCOLATE = "chocolate"
    CHEESE = "cheese"
    CREAM = "cream"
    EGG = "egg"
    MEAT = "meat"
    ROAST = "roast"
    FISH = "fish"
    SHELLFISH = "shellfish"
    ICE = "ice"
    SAUCE = "sauce"
    SPICE = "spice"


@dataclass(frozen=True, slots=True)
class Material:
    """Look of a surface: sRGB colour from 0 to 1, pattern, and three shares.

    ``gloss`` is the share of reflected surroundings, ``metal`` the tint of reflections by the colour, ``glow`` the light that
    the surface emits. ``palette`` holds all colours in which such things come: packages, books and clothes differ.
    """

    color: Rgb
    pattern: Pattern = Pattern.PLAIN
    gloss: float = 0.0
    metal: float = 0.0
    glow: float = 0.0
    palette: tuple[Rgb, ...] = ()


_P: Final = Pattern
_K: Final = MaterialKind

MATERIALS: Final[dict[MaterialKind, Material]] = {
    _K.OAK: Material(
        (0.70, 0.52, 0.33),
        _P.GRAIN,
        gloss=0.03,
        palette=(
            (0.70, 0.52, 0.33),
            (0.64, 0.46, 0.28),
            (0.76, 0.58, 0.38),
        ),
    ),
    _K.WALNUT: Material(
        (0.45, 0.30, 0.20),
        _P.GRAIN,
        gloss=0.04,
        palette=(
            (0.45, 0.30, 0.20),
            (0.40, 0.25, 0.16),
        ),
    ),
    _K.PINE: Material((0.83, 0.68, 0.46), _P.GRAIN),
    _K.BAMBOO: Material((0.84, 0.72, 0.46), _P.GRAIN),
    _K.LACQUER: Material((0.88, 0.87, 0.83), _P.PLAIN, gloss=0.05),
    _K.STEEL: Material((0.72, 0.74, 0.76), _P.BRUSHED, gloss=0.45, metal=1.0),
    _K.IRON: Material((0.23, 0.23, 0.24), _P.BRUSHED, gloss=0.12, metal=0.6),
    _K.BRASS: Material((0.80, 0.64, 0.30), _P.BRUSHED, gloss=0.4, metal=1.0),
    _K.COPPER: Material((0.76, 0.44, 0.30), _P.BRUSHED, gloss=0.4, metal=1.0),
    _K.ALUMINIUM: Material((0.80, 0.81, 0.82), _P.BRUSHED, gloss=0.3, metal=1.0),
    _K.PORCELAIN: Material((0.93, 0.93, 0.91), gloss=0.12),
    _K.STONEWARE: Material(
        (0.48, 0.62, 0.70),
        _P.PLAIN,
        gloss=0.08,
        palette=(
            (0.48, 0.62, 0.70),
            (0.90, 0.88, 0.83),
            (0.62, 0.68, 0.56),
            (0.72, 0.46, 0.34),
            (0.36, 0.38, 0.42),
        ),
    ),
    _K.TERRACOTTA: Material((0.71, 0.40, 0.27), _P.PLASTER),
    _K.GLASS: Material((0.72, 0.83, 0.84), gloss=0.35),
    _K.MIRROR: Material((0.86, 0.92, 0.95), gloss=0.85, metal=1.0),
    _K.GRANITE: Material((0.40, 0.40, 0.41), _P.STONE, gloss=0.08),
    _K.STONE: Material((0.66, 0.64, 0.60), _P.STONE),
    _K.PLASTER: Material((0.90, 0.88, 0.84), _P.PLASTER),
    _K.WHITE_PLASTIC: Material((0.90, 0.90, 0.89), gloss=0.05),
    _K.BLACK_PLASTIC: Material((0.13, 0.13, 0.14), gloss=0.08),
    _K.PLASTIC: Material(
        (0.30, 0.50, 0.70),
        gloss=0.06,
        palette=(
            (0.24, 0.46, 0.70),
            (0.78, 0.24, 0.20),
            (0.92, 0.74, 0.22),
            (0.30, 0.58, 0.36),
            (0.88, 0.50, 0.20),
            (0.86, 0.86, 0.84),
        ),
    ),
    _K.RUBBER: Material((0.18, 0.18, 0.18)),
    _K.SCREEN: Material((0.10, 0.13, 0.18), _P.SCREEN, gloss=0.18),
    _K.PICTURE: Material(
        (0.80, 0.76, 0.68),
        _P.PICTURE,
        palette=(
            (0.80, 0.76, 0.68),
            (0.70, 0.78, 0.84),
            (0.86, 0.74, 0.62),
        ),
    ),
    _K.LAMPSHADE: Material((0.97, 0.90, 0.74), _P.WEAVE, glow=0.35),
    _K.LIGHT: Material((1.0, 0.97, 0.90), glow=0.7),
    _K.WAX: Material((0.93, 0.88, 0.76)),
    _K.UPHOLSTERY: Material(
        (0.36, 0.45, 0.56),
        _P.WEAVE,
        palette=(
            (0.34, 0.43, 0.54),
            (0.52, 0.54, 0.40),
            (0.66, 0.42, 0.32),
            (0.60, 0.58, 0.54),
            (0.28, 0.46, 0.48),
            (0.72, 0.62, 0.48),
        ),
    ),
    _K.LINEN: Material((0.88, 0.86, 0.81), _P.WEAVE),
    _K.TEXTILE: Material(
        (0.36, 0.46, 0.66),
        _P.WEAVE,
        palette=(
            (0.32, 0.42, 0.62),
            (0.70, 0.30, 0.28),
            (0.86, 0.84, 0.78),
            (0.34, 0.50, 0.42),
            (0.78, 0.62, 0.36),
            (0.30, 0.32, 0.38),
            (0.62, 0.70, 0.78),
        ),
    ),
    _K.TOWEL: Material(
        (0.76, 0.84, 0.86),
        _P.CARPET,
        palette=(
            (0.88, 0.88, 0.85),
            (0.62, 0.76, 0.84),
            (0.82, 0.74, 0.62),
            (0.68, 0.78, 0.68),
            (0.86, 0.66, 0.64),
        ),
    ),
    _K.RUG: Material(
        (0.62, 0.38, 0.32),
        _P.RUG,
        palette=(
            (0.62, 0.30, 0.26),
            (0.30, 0.38, 0.54),
            (0.72, 0.64, 0.50),
            (0.44, 0.52, 0.44),
        ),
    ),
    _K.LEATHER: Material((0.38, 0.23, 0.15), _P.SKIN, gloss=0.05),
    _K.WICKER: Material((0.70, 0.54, 0.34), _P.WEAVE),
    _K.FUR: Material((0.60, 0.44, 0.28), _P.CARPET),
    _K.PAPER: Material((0.93, 0.92, 0.87)),
    _K.CARDBOARD: Material((0.72, 0.56, 0.38), _P.PLASTER),
    _K.BOOK: Material(
        (0.46, 0.26, 0.26),
        palette=(
            (0.52, 0.18, 0.18),
            (0.18, 0.28, 0.48),
            (0.20, 0.40, 0.28),
            (0.74, 0.58, 0.32),
            (0.20, 0.20, 0.22),
            (0.82, 0.80, 0.74),
            (0.70, 0.38, 0.18),
        ),
    ),
    _K.PACKAGE: Material(
        (0.72, 0.36, 0.28),
        _P.LABEL,
        palette=(
            (0.78, 0.22, 0.18),
            (0.20, 0.42, 0.70),
            (0.92, 0.72, 0.20),
            (0.28, 0.56, 0.32),
            (0.90, 0.50, 0.18),
            (0.88, 0.86, 0.80),
            (0.50, 0.34, 0.22),
        ),
    ),
    _K.BOTTLE: Material(
        (0.34, 0.52, 0.40),
        _P.LABEL,
        gloss=0.15,
        palette=(
            (0.20, 0.44, 0.28),
            (0.48, 0.28, 0.12),
            (0.66, 0.80, 0.84),
            (0.24, 0.44, 0.66),
            (0.90, 0.90, 0.88),
        ),
    ),
    _K.JAR: Material(
        (0.72, 0.52, 0.32),
        _P.LABEL,
        gloss=0.15,
        palette=(
            (0.72, 0.52, 0.32),
            (0.62, 0.24, 0.16),
            (0.80, 0.70, 0.52),
        ),
    ),
    _K.TIN: Material(
        (0.62, 0.64, 0.68),
        _P.LABEL,
        gloss=0.2,
        palette=(
            (0.62, 0.64, 0.68),
            (0.72, 0.24, 0.20),
            (0.24, 0.44, 0.66),
            (0.32, 0.52, 0.34),
        ),
    ),
    _K.SACK: Material((0.76, 0.66, 0.48), _P.LABEL),
    _K.FOLIAGE: Material((0.24, 0.46, 0.18), _P.LEAVES),
    _K.LAWN: Material((0.46, 0.55, 0.32), _P.GRASS),
    _K.BARK: Material((0.38, 0.28, 0.20), _P.GRAIN),
    _K.SOIL: Material((0.32, 0.23, 0.16), _P.CRUMB),
    _K.SAND: Material((0.84, 0.75, 0.56), _P.CRUMB),
    _K.WATER: Material((0.60, 0.78, 0.86), gloss=0.3),
    _K.FLOWER: Material(
        (0.86, 0.38, 0.50),
        _P.LEAVES,
        palette=(
            (0.88, 0.42, 0.52),
            (0.94, 0.80, 0.30),
            (0.78, 0.18, 0.20),
            (0.60, 0.42, 0.74),
            (0.94, 0.92, 0.90),
        ),
    ),
    _K.LEAFY: Material((0.38, 0.62, 0.20), _P.LEAVES),
    _K.GREEN: Material((0.47, 0.66, 0.22), _P.SKIN, gloss=0.05),
    _K.RED: Material((0.78, 0.13, 0.11), _P.SKIN, gloss=0.06),
    _K.ORANGE: Material((0.94, 0.52, 0.10), _P.SKIN, gloss=0.04),
    _K.YELLOW: Material((0.95, 0.80, 0.18), _P.SKIN, gloss=0.03),
    _K.PURPLE: Material((0.36, 0.16, 0.36), _P.SKIN, gloss=0.06),
    _K.BROWN: Material((0.47, 0.32, 0.18), _P.SKIN),
    _K.PINK: Material((0.93, 0.62, 0.64), _P.SKIN),
    _K.MUSHROOM: Material((0.80, 0.73, 0.62), _P.SKIN),
    _K.ROOT: Material((0.78, 0.62, 0.40), _P.SKIN),
    _K.BREAD: Material((0.80, 0.56, 0.28), _P.CRUMB),
    _K.DOUGH: Material((0.92, 0.84, 0.66), _P.CRUMB),
    _K.CHOCOLATE: Material((0.32, 0.19, 0.12), _P.CRUMB, gloss=0.04),
    _K.CHEESE: Material((0.95, 0.78, 0.36), _P.SKIN),
    _K.CREAM: Material((0.96, 0.93, 0.85)),
    _K.EGG: Material((0.93, 0.85, 0.74)),
    _K.MEAT: Material((0.76, 0.34, 0.32), _P.SKIN, gloss=0.05),
    _K.ROAST: Material((0.62, 0.36, 0.18), _P.CRUMB, gloss=0.04),
    _K.FISH: Material((0.72, 0.62, 0.60), _P.SKIN, gloss=0.12),
    _K.SHELLFISH: Material((0.88, 0.50, 0.38), _P.SKIN, gloss=0.06),
    _K.ICE: Material((0.84, 0.92, 0.96), gloss=0.3),
    _K.SAUCE: Material((0.62, 0.22, 0.10), gloss=0.1),
    _K.SPICE: Material((0.70, 0.44, 0.18), _P.CRUMB),
}
