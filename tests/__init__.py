"""Tests of manylights; `tests/README.md` says how they are organised."""
