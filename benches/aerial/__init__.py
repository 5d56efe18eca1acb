"""Large synthetic sparse models of aerial surveys, without images, for measurements of speed and memory. Needs numpy.

A drone flies a grid 60 m above undulating terrain with buildings and trees (80 % forward and 70 % side overlap; 60 % of the views nadir, 40 %
oblique in four headings). Points are sampled on terrain, roofs, walls and crowns. A view can observe a point that is in its image, faces it, and
has a free line of sight in a raster of 0.5 m; it does so at random, the less likely the more its direction differs from one that the point
prefers, so that track lengths vary as in real models. Observations get Gaussian noise, and each point moves to where a triangulation from
its observations would put it. Metres, z up, one PINHOLE camera of 5472 x 3648. The same numbers and seed give the same bytes.

    site       terrain, buildings and crowns, and points on them
    flight     poses
    visible    which points a view observes
    model      a whole model, and its files
"""
