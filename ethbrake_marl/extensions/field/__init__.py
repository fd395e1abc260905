"""Controllers from the literature for comparison (IDM, ACC, CACC, RSS, UN R157, AEB), and its measures (TTC, DRAC)."""
