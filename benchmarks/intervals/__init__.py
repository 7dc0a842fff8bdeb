"""Do prediction intervals hold what they promise?"""
