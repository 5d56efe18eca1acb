"""Data sets of photographs from public repositories: reduced, matched and mapped by pycolmap, aligned, undistorted.

    pictures     takes the photographs out of a clone, reduces them, reads their EXIF
    mapping      features, pairs, structure from motion
    alignment    scale and orientation by GPS, ground control or the ground's plane
    model        the part of a model that is kept, undistortion, figures
    recipe       choices that differ from set to set
    make         the steps one after the other
"""
