"""The generators of pages, one a file. Each has `pages`: the text of each page by its path, and the folder that holds
nothing but them."""
