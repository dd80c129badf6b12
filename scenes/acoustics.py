"""Acoustic properties of tissues and materials, and the material of each thing.

Values at room temperature (22 °C). Sources: [D] Duck 1990, Physical properties of tissue; [C] Culjat et al. 2010, A review of
tissue substitutes for ultrasound imaging, Ultrasound Med. Biol. 36(6); [K] Kaye & Laby / ONDA tables of acoustic properties;
[M] Marczak 1997 (water); [A] D'Astous & Foster 1986, Ultrasound Med. Biol. 12(10) (breast tissue). Those of a patient at body
temperature: [L] Li, Villa, Park & Anastasio 2022, IEEE Trans. UFFC 69(1) (speed and density of breast tissues, from IT'IS and
measured tumours); [F] Nasief et al. 2015, J. Ultrasound Med. 34(11) (attenuation and backscatter of breast fat); [N] Nam et al.
2013, Ultrason. Imaging 35(2) (masses); [I] Hasgall et al., IT'IS tissue data base 4.1. Young's moduli: fat 3.25
and gland 3.24 kPa [Samani, Zubovits & Plewes 2007, Phys. Med. Biol. 52(6)], others assumed: skin, ligaments and fascia some 20
times as stiff, a phantom's tumours thrice as its rest. How uneven strands are is assumed by the look of published images.
"""

from dataclasses import replace

from recon import registry
from recon.errors import InputError
from recon.probe_calibration.sound_in_water import speed_of_sound
from scenes.scene_types import Layer, Scene, Thing
from scenes.tissue import Tissue

BACKSCATTER = 1e-4  # 1/(mm sr), that is 1e-3 /(cm sr): of soft tissue near 7 MHz [D, A: 1e-4 to 1e-2 for fat to tumour]

TISSUES = {
    "water": Tissue(1.486, 1488.3, 0.0165, None),  # [M] at 22 °C; its 0.0022 dB/cm/MHz² [D] grow with the square, here at 7.5 MHz
    "gel": Tissue(
        1.55, 1520.0, 0.02, None, soft=True
    ),  # coupling gel: water with a few per cent of polymer; assumed between water and tissue
    "silicone": Tissue(
        1.50, 1450.0, 0.6, 2.0, 0.01, True, modulus_kpa=30.0
    ),  # a soft breast phantom: fat to gland [A, C], adipose speed 1450
    "tumour": Tissue(
        1.58, 1530.0, 0.9, -12.0, 0.02, True, modulus_kpa=90.0
    ),  # masses are darker, stiffer, faster and absorb more [A]
    "gelatin": Tissue(1.60, 1540.0, 0.5, 0.0, 0.005, True),  # gelatin or agar with graphite, like tissue [C], made for 1540 m/s
    "cyst": Tissue(1.57, 1540.0, 0.05, None, 0.005, True),  # fluid, matched in speed
    "bright": Tissue(1.61, 1540.0, 0.5, 6.0, 0.005, True),  # inclusions of a grey-scale test object
    "dark": Tissue(1.59, 1540.0, 0.5, -6.0, 0.005, True),
    "polymer": Tissue(3.2, 2700.0, 1.4, None, 0.001),  # acrylic glass, nylon and their like [K]
    "sanded": Tissue(3.2, 2700.0, 1.4, None, 0.03),  # the same, sanded or under matt paint: it scatters to all sides; assumed
    "steel": Tissue(46.0, 5900.0, 0.2, None, 0.002),  # [K]
    "wood": Tissue(1.9, 3300.0, 8.0, -4.0, 0.03),  # assumed, across the grain: it absorbs all
    "nylon": Tissue(2.9, 2600.0, 1.0, None, 0.01),  # wires and fishing line [K]
    "skin": Tissue(
        1.72, 1555.0, 1.84, 6.0, 0.03, True, strands_db=4.0, modulus_kpa=60.0
    ),  # 1109 kg/m3, 1555 m/s [L]; attenuation [I]; echoes assumed, as bright as gland, in plies
    "fat": Tissue(
        1.31, 1440.0, 0.73, 0.0, 0.015, True
    ),  # 911 kg/m3, 1440 m/s [L]; attenuation at 7 MHz [F]; reference of BI-RADS
    "ligament": Tissue(
        1.66, 1457.0, 2.5, 5.0, 0.015, True, 15.0, modulus_kpa=60.0
    ),  # 1142 kg/m3, 1457 m/s [L]; they shadow: twice the attenuation of [L], for what they bend aside; echoes assumed
    "gland": Tissue(
        1.60, 1540.0, 0.75, 8.5, 0.015, True, strands_db=2.5, modulus_kpa=3.24
    ),  # 1041 kg/m3, 1540 m/s, attenuation [L]; 7 times the echo of fat, which is 10 [A] less some that scanners' medians ask for
    "duct": Tissue(1.56, 1520.0, 0.3, -4.0, 0.01, True, modulus_kpa=3.24),  # fluid and walls, assumed
    "nipple": Tissue(1.72, 1555.0, 3.0, 2.0, 0.02, True, modulus_kpa=15.0),  # dense connective tissue that shadows, assumed
    "muscle": Tissue(
        1.73, 1588.0, 0.62, 2.0, 0.02, True, 3.0, 2.5, modulus_kpa=10.0
    ),  # 1090 kg/m3, 1588 m/s, attenuation [I]; echoes assumed, dark between bright septa
    "fascia": Tissue(1.83, 1664.0, 1.2, 8.0, 0.02, True, 12.0, modulus_kpa=60.0),  # as ligaments and tendons [I]; echoes assumed
    "bone": Tissue(6.7, 3515.0, 4.74, 0.0, 0.006),  # 1908 kg/m3, 3515 m/s, attenuation [I]
    "lung": Tissue(
        0.37, 949.0, 1.0, 8.0, 0.008
    ),  # 394 kg/m3, 949 m/s [I]; what alveoli throw to and fro trails behind its face, assumed
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
    if tissue == TISSUES["water"]:
        ratio = float(speed_of_sound(WATER_C + warmer_c) / speed_of_sound(WATER_C))
    elif not tissue.soft:
        return tissue
    return replace(tissue, speed=tissue.speed * ratio, impedance=tissue.impedance * ratio)


def tissue_of(scene: Scene, thing: Thing | Layer) -> Tissue:
    """The material of a scene's thing or layer.

    Raises
    ------
    InputError
        If nobody has said so.
    """
    if isinstance(thing, Thing) and thing.tissue is not None:
        return thing.tissue
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
