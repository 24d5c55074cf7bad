"""The stages of `lgmdjax reproduce`, their settings at three scales, and the report page."""
