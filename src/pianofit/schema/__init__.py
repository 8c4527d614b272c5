"""The schema: every JSON file of this package as frozen records, checked when a file is read.

`fit` has the records of a `fit.json`, `modal_response` those of modes and knock, `quantities` reported numbers with
intervals. `notes` turns a fit into notes to play. `decode` reads and writes records of any kind. Only this
package knows the keys of files.
"""
