"""Controllers from the literature to compare with: IDM, ACC, RSS, UN R157, AEB."""
