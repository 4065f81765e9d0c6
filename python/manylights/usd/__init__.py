"""USD stages as dictionaries for ``mi.load_dict``; needs ``pip install 'manylights[usd]'``."""
