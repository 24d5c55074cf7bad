"""Figures of the report and the notebooks: numbers in, a matplotlib `Figure` out."""
