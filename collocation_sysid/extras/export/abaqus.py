"""Abaqus: the card of the material, with the estimates and their intervals in comments.

Directions of fibres are those of elements: a body with fibres gets an input deck, too.
"""

from __future__ import annotations

from ...fem.laws.fibres import ReinforcedMaterial
from .calculix import abaqus_fibre_card, format_values, input_deck, material_card, memory_card
from .identified import IdentifiedBody
from .target import ExportedFiles, as_comments, require_known_laws

# Abaqus includes a file of any suffix; .inp is that of a deck.
CARD = "material.inc"
DECK = "abaqus.inp"


def export(body: IdentifiedBody) -> ExportedFiles:
    """Return the card and, for a body with fibres, the deck, as text, and what Abaqus cannot express;
    nothing is written.

    Raises
    ------
    InputError
        For a law that Abaqus does not have.
    """
    require_known_laws(body, "abaqus")
    limits, cards = [], ""
    for region, part in zip(body.regions, body.body.parts, strict=True):
        if isinstance(part.material, ReinforcedMaterial):
            card, limitation = abaqus_fibre_card(region, part.material.energy.fibres)
        else:
            card, limitation = material_card(region)
        limits += [f"{region.name}: {limitation}"] if limitation else []
        name = region.name.upper()
        cards += f"*MATERIAL,NAME={name}\n{card}{memory_card(region)}"
        if body.experiment.specimen is None:  # a specimen has a nominal density
            cards += f"*DENSITY\n{format_values(region.density_kg_m3)}\n"
    lines = [f"{body.title}: SI units; verdict: {body.verdict}"]
    lines += [f"not expressed: {each}" for each in limits]
    for name, estimate in body.parameters.items():
        known = "fixed" if estimate.fixed or estimate.tied else "interval not known"
        if estimate.combined95 is not None:
            low, high = estimate.combined95
            known = f"95 % interval {low:.4g} to {high:.4g}"
        lines.append(f"{name} = {estimate.value:.6g} ({known})")
    files = {CARD: as_comments(lines, "** ") + cards}
    if any(isinstance(part.material, ReinforcedMaterial) for part in body.body.parts):
        files[DECK], _ = input_deck(body, for_abaqus=True)
    return ExportedFiles(files, tuple(limits))
