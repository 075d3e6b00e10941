"""mpmbench: which particle-grid transfer strategy is fastest on this GPU, for these particles, and why?"""
