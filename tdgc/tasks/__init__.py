"""The two MDPs with their rewards and curricula, and the scripted teacher."""
