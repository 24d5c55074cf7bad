"""The paper's trials and the metrics of their outcome."""
