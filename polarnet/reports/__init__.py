"""What a person looks at: figures, tables, the page."""
