"""Report of a design: report.json, the page, and the words of terminal and pages."""
