"""The paper that this package grew from (Siswantoro et al. 2013): its route, its experiment and its set-up."""
