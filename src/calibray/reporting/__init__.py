"""The report page, tables, figures and exports of finished calibrations.

This subpackage only reads records. This package does not import `calibration`, so a result can be displayed on machines
that cannot trace.
"""
