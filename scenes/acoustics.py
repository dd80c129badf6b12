"""Acoustic properties of tissues and materials, and the material of each thing.

Values at room temperature (22 °C). Sources: [D] Duck 1990, Physical properties of tissue; [C] Culjat et al. 2010, A review of
tissue substitutes for ultrasound imaging, Ultrasound Med. Biol. 36(6); [K] Kaye & Laby / ONDA tables of acoustic properties;
[M] Marczak 1997 (water); [A] D'Astous & Foster 1986, Ultrasound Med. Biol. 12(10) (breast tissue).
"""

from dataclasses import dataclass, replace

from recon import registry
from recon.errors import InputError
from recon.probe_calibration.sound_in_water import speed_of_sound
from scenes.scene_types import Scene, Thing


@dataclass(frozen=True)
class Tissue:
    """An acoustic medium.

    Raises
    ------
    ValueError
        If impedance or speed isn't positive, or a loss is negative.
    """

    impedance: float  # MRayl
    speed: float  # m/s
    attenuation: float  # dB/cm/MHz
    echogenicity: float | None  # dB of the backscatter coefficient over `BACKSCATTER`; None is free of echoes
    roughness: float = 0.0  # mm, standard deviation of its surface over less than a wavelength

    def __post_init__(self) -> None:
        if not (self.impedance > 0 and self.speed > 0):
            raise ValueError(f"impedance and speed: expected more than 0, found {self.impedance} and {self.speed}")
        if self.attenuation < 0 or self.roughness < 0:
            raise ValueError(f"attenuation and roughness: expected 0 or more, found {self.attenuation} and {self.roughness}")


BACKSCATTER = 1e-4  # 1/(mm sr), that is 1e-3 /(cm sr): of soft tissue near 7 MHz [D, A: 1e-4 to 1e-2 for fat to tumour]

TISSUES = {
    "water": Tissue(1.486, 1488.3, 0.0165, None),  # [M] at 22 °C; its 0.0022 dB/cm/MHz² [D] grow with the square, here at 7.5 MHz
    "gel": Tissue(
        1.55, 1520.0, 0.02, None
    ),  # coupling gel: water with a few per cent of polymer; assumed between water and tissue
    "silicone": Tissue(1.50, 1450.0, 0.6, 2.0, 0.01),  # body of a soft breast phantom: fat to gland [A, C], adipose speed 1450
    "tumour": Tissue(1.58, 1530.0, 0.9, -12.0, 0.02),  # masses are darker, stiffer, faster and absorb more [A]
    "gelatin": Tissue(1.60, 1540.0, 0.5, 0.0, 0.005),  # tissue-mimicking gelatin or agar with graphite [C], made for 1540 m/s
    "cyst": Tissue(1.57, 1540.0, 0.05, None, 0.005),  # fluid, matched in speed
    "bright": Tissue(1.61, 1540.0, 0.5, 6.0, 0.005),  # inclusions of a grey-scale test object
    "dark": Tissue(1.59, 1540.0, 0.5, -6.0, 0.005),
    "polymer": Tissue(3.2, 2700.0, 1.4, None, 0.001),  # acrylic glass, nylon and their like [K]
    "sanded": Tissue(3.2, 2700.0, 1.4, None, 0.03),  # the same, sanded or under matt paint: it scatters to all sides; assumed
    "steel": Tissue(46.0, 5900.0, 0.2, None, 0.002),  # [K]
    "wood": Tissue(1.9, 3300.0, 8.0, -4.0, 0.03),  # assumed, across the grain: it absorbs all
    "nylon": Tissue(2.9, 2600.0, 1.0, None, 0.01),  # wires and fishing line [K]
}

KINDS = "scenes.kinds"  # of scenes, a module each
WATER_C = 22.0  # of the water above


def made_of(kind: str) -> dict[str, str]:
    """Tissues by the names of a kind's things without their number, `MADE_OF` in its module; "" is what surrounds them."""
    return getattr(registry.kind(KINDS, kind), "MADE_OF", {}) if kind in registry.names(KINDS) else {}


def surroundings(scene: Scene) -> Tissue:
    """The medium between and around a scene's things."""
    return TISSUES[_table(scene)[""]]


def faster(tissue: Tissue, ratio: float, warmer_c: float) -> Tissue:
    """The same medium, soft, at a ratio of its speed, or water at another temperature; densities stay."""
    soft = ("gel", "silicone", "tumour", "gelatin", "cyst", "bright", "dark")  # of which the speed is that of tissue
    if tissue == TISSUES["water"]:
        ratio = float(speed_of_sound(WATER_C + warmer_c) / speed_of_sound(WATER_C))
    elif tissue not in [TISSUES[name] for name in soft]:
        return tissue
    return replace(tissue, speed=tissue.speed * ratio, impedance=tissue.impedance * ratio)


def tissue_of(scene: Scene, thing: Thing) -> Tissue:
    """The material of a scene's thing.

    Raises
    ------
    InputError
        If nobody has said so.
    """
    known, name = _table(scene), thing.name.rstrip("0123456789")
    if name not in known:
        raise InputError(f"{scene.name}: {thing.name}: expected one of {', '.join(filter(None, known))}, found no tissue for it")
    return TISSUES[known[name]]


def _table(scene: Scene) -> dict[str, str]:
    table = made_of(scene.name)
    if not table:
        sounding = [name for name in registry.names(KINDS) if made_of(name)]
        raise InputError(f"scene: {scene.name}: expected one with acoustics ({', '.join(sounding)}), found none for it")
    return table
