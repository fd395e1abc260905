"""The shield ``robust``, which reckons with ranges; and ``plan:estimated``, which plans for lines that are possible."""
