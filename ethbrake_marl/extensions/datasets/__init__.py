"""Write recorded episodes as datasets, in the formats Parquet and Minari."""

from ethbrake_marl.extensions.datasets.minari import write_dataset as write_dataset
