"""Controllers that the field compares with: IDM, ACC, RSS, UN R157, AEB."""
