// The yardstick of benches/delaunay.py: CGAL's sequential 3D Delaunay triangulation with spatial sort.
// Usage: cgal_delaunay POINTS [CELLS]. Reads little-endian f64 triples; prints dimension, vertices, finite cells, all cells,
// seconds; writes the finite cells as little-endian u32 quadruples of indices of points.

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

static bool write_cells(const Delaunay& delaunay, const char* path) {
  std::FILE* file = std::fopen(path, "wb");
  if (!file) return false;
  for (auto cell = delaunay.finite_cells_begin(); cell != delaunay.finite_cells_end(); ++cell) {
    unsigned points[4];
    for (int i = 0; i < 4; ++i) points[i] = cell->vertex(i)->info();
    std::fwrite(points, sizeof points, 1, file);
  }
  return std::fclose(file) == 0;
}

int main(int argc, char** argv) {
  if (argc < 2 || argc > 3) return 2;
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
  return argc == 3 && delaunay.dimension() == 3 && !write_cells(delaunay, argv[2]);
}
