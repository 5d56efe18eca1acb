# One DSM or mesh run joins what is in projects/, so that only projects of this plan, NAME-RECIPE, stay there, beside folders of the user's own.
result="*-$recipe"
only projects "$results"
for project in projects/*; do
    # Of an earlier version of this script.
    [ ! -f "$project/viewrank.recipe" ] || put_aside "$project"
done
own_files .
