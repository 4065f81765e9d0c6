"""Stability: scenes where methods fail, with what keeps them from failing."""
