"""What is shown: records as tables, tables as text, as HTML and in Markdown, and figures.

Records are handed in. This room imports none of the machinery that makes them, so that a record can show itself and a
command print it where nothing can be traced.
"""
