"""The steps of the page, one module each; `show` draws a step, and draws it again after a command."""
