# Projects of views that are no key views now, and those of another recipe (partners, size), go to older/: one DSM or mesh run joins what is in projects/.
mkdir -p projects older || exit 1
old() {
    rm -rf "older/$1"
    mv "projects/$1" older/ || exit 1
}
for project in projects/*; do
    if [ -e "$project" ] && [ ! -e "clusters/${project#projects/}" ]; then
        old "${project#projects/}"
    fi
done
set_aside() {
    if [ -e "done/$name" ] && [ -e "projects/$name" ]; then
        old "$name"
    fi
}
