"""The two MDPs, their rewards, curricula and the scripted teacher."""
