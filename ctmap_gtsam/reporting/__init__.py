"""What people look at: tables, plots, overlays, report.html."""
