"""Method ``mixture``: adaptive multiple importance sampling."""
