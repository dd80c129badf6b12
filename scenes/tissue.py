"""What sound meets in a tissue or material."""

from dataclasses import dataclass


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
    echogenicity: float | None  # dB of the backscatter coefficient over `scenes.acoustics.BACKSCATTER`; None is free of echoes
    roughness: float = 0.0  # mm, standard deviation of its surface over less than a wavelength
    soft: bool = False  # whether its speed goes with that of all soft tissue
    fibres_db: float = 0.0  # by which a layer of fibres is brighter where sound meets it squarely
    strands_db: float = 0.0  # standard deviation of the backscatter from strand to strand, where layers have grown
    specks_per_mm3: float = 0.0  # calcifications
    modulus_kpa: float = 3.25  # Young's, at small strains, of what is soft

    def __post_init__(self) -> None:
        if not (self.impedance > 0 and self.speed > 0):
            raise ValueError(f"impedance and speed: expected more than 0, found {self.impedance} and {self.speed}")
        if not self.modulus_kpa > 0:
            raise ValueError(f"modulus_kpa: expected more than 0, found {self.modulus_kpa}")
        if self.attenuation < 0 or self.roughness < 0:
            raise ValueError(f"attenuation and roughness: expected 0 or more, found {self.attenuation} and {self.roughness}")
