# One DSM or mesh run joins what is in projects/, so that only projects of this plan, NAME-RECIPE, stay there, beside folders of the user's own.
result='*-????????????????'
only projects "$results"
