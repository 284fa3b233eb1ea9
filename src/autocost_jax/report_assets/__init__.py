"""Parts of the report: its records, its figures, and the page's static text."""
