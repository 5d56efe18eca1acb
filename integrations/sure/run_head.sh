# One DSM or mesh run joins what is in projects/, so that only projects of this plan stay there. Others are kept in older/: those that were finished come
# back when a plan needs them again. projects/NAME/viewrank.recipe says what a project was made from; folders without it are not touched.
mkdir -p projects older || exit 1
made_from() { cat "$1/viewrank.recipe" 2>/dev/null; }
# Moves a project away: NAME
old() {
    made=$(made_from "projects/$1") kept=older/$1-$made
    if [ "$(cat "done/$1" 2>/dev/null)" != "$made" ] || [ -e "$kept" ]; then
        number=1
        while [ -e "$kept-$number" ]; do number=$((number + 1)); done
        kept=$kept-$number
    fi
    mv "projects/$1" "$kept" && rm -f "done/$1" || exit 1
}
for project in projects/*; do
    case " $keys " in
    *" ${project#projects/} "*) ;;
    *) [ ! -f "$project/viewrank.recipe" ] || old "${project#projects/}" ;;
    esac
done
set_aside() {
    if [ -e "projects/$name" ] && [ "$(made_from "projects/$name")" != "$recipe" ]; then
        old "$name"
    fi
}
# A finished project that the plan asks for again: NAME RECIPE
back() {
    [ -e "older/$1-$2" ] && [ "$(made_from "projects/$1")" != "$2" ] || return 0
    [ ! -e "projects/$1" ] || old "$1"
    mkdir -p done && mv "older/$1-$2" "projects/$1" && echo "$2" >"done/$1" || exit 1
}
project() { mkdir -p "projects/$name" && echo "$recipe" >"projects/$name/viewrank.recipe"; }
