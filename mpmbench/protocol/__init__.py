"""How times are taken and compared: paired rounds of every contender, on whatever clock there is.

``rounds`` takes the samples, ``verdict`` says what they mean, ``clocks`` are the clocks of real devices and
``scripted`` one that tests write the script of. Nothing here knows what is timed. docs/measuring.md has the reasons.
"""
