"""Shields for incomplete knowledge: ``robust`` for uncertain quantities, ``estimated`` for unknown vehicles."""
