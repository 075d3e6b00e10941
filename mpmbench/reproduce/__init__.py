"""The thesis's tables beside what the model says of the same rows: rows, score, frozen state, one page.

``rows`` makes the rows; everything else here works on rows alone and touches neither a device nor the model.
"""
