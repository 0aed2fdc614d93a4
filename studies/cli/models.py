"""List the networks that come with the package, from their cards."""

from __future__ import annotations

from dataclasses import dataclass

from studies.options import Common, Positional, Progress


@dataclass(frozen=True, kw_only=True)
class Models(Common):
    """List the models that come with the package: design, compression, training set, photon levels, error, limits."""

    name: Positional[str] = ""
    """Show this one's whole card."""


def run(command: Models, progress: Progress) -> dict:
    """Cards of the shipped models, a line each, or one's whole."""
    from csph.cards import cards, read_card, shipped_model

    if command.name:
        return read_card(shipped_model(command.name).with_suffix(".json")).to_dict()
    found = cards()
    if command.json:
        return {"models": [card.to_dict() for card in found]}
    lines = []
    for card in found:
        error = "no error recorded" if card.val_mae_mm is None else f"validation MAE {card.val_mae_mm:.1f} mm"
        said = f"{card.name}: {card.model}, {card.compression:g}x; {', '.join(card.training)}; {card.levels}; {error}"
        lines.append(f"{said}; not for {'; '.join(card.not_for)}")
    return {"models": lines}
