"""The workbench: a local page on which a person edits a scene while a preview follows."""
