// The yardstick of benches/delaunay.py: CGAL's sequential 3D Delaunay triangulation with spatial sort.
// Usage: cgal_delaunay POINTS, little-endian f64 triples. Prints dimension, vertices, finite cells, all cells, seconds.

#include <CGAL/Delaunay_triangulation_3.h>
#include <CGAL/Exact_predicates_inexact_constructions_kernel.h>
#include <CGAL/Triangulation_vertex_base_with_info_3.h>

#include <chrono>
#include <cstdio>
#include <utility>
#include <vector>

using Kernel = CGAL::Exact_predicates_inexact_constructions_kernel;
using Vertex = CGAL::Triangulation_vertex_base_with_info_3<unsigned, Kernel>;
using Cell = CGAL::Delaunay_triangulation_cell_base_3<Kernel>;
using Structure = CGAL::Triangulation_data_structure_3<Vertex, Cell, CGAL::Sequential_tag>;
using Delaunay = CGAL::Delaunay_triangulation_3<Kernel, Structure>;

int main(int argc, char** argv) {
  if (argc != 2) return 2;
  std::FILE* file = std::fopen(argv[1], "rb");
  if (!file) return 1;
  std::vector<std::pair<Kernel::Point_3, unsigned>> points;
  double p[3];
  while (std::fread(p, sizeof p, 1, file) == 1)
    points.emplace_back(Kernel::Point_3(p[0], p[1], p[2]), unsigned(points.size()));
  std::fclose(file);
  const auto start = std::chrono::steady_clock::now();
  const Delaunay delaunay(points.begin(), points.end());
  const std::chrono::duration<double> seconds = std::chrono::steady_clock::now() - start;
  std::printf("%d %zu %zu %zu %.3f\n", delaunay.dimension(), size_t(delaunay.number_of_vertices()),
              size_t(delaunay.number_of_finite_cells()), size_t(delaunay.number_of_cells()), seconds.count());
}
