"""Files of a lens for shops and other programs: data sheet, drawings, tables, tiles, tool paths."""
