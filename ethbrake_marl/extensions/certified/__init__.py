"""Shields for incomplete knowledge: ``robust`` for uncertain quantities, ``estimated`` for values not received yet."""
