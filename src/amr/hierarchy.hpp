/// \file
/// Every node of the tree, level by level, parents included, and grids of fewer and fewer cells beneath the roots:
/// the ladder that multigrid climbs, and the arrays that live on it.
#pragma once

#include <mpi.h>

#include <array>
#include <functional>
#include <span>
#include <vector>

#include "amr/mesh.hpp"
#include "amr/transfer.hpp"

namespace dendrift::amr {

/// A value on a side of the domain: affine, plus a constant that falls off as a parabola along some axes.
struct SideValue {
  double constant = 0;
  RealVec gradient{};  ///< the affine part is gradient . (x - centre)
  RealVec centre{};
  RealVec half{};      ///< > 0: the constant falls to 0 so far from the centre along this axis
  bool uniform() const {
    for (int a = 0; a < DIM; ++a)
      if (gradient[a] != 0 || half[a] > 0) return false;
    return true;
  }
  /// Mean over a place of width dx on the side, so that what flows through a side does not depend on the level.
  double at(const RealVec& x, double dx) const {
    double fall = constant, affine = 0;
    for (int a = 0; a < DIM; ++a) {
      const double r = x[a] - centre[a];
      affine += gradient[a] * r;
      if (half[a] > 0) fall *= 1 - (r * r + dx * dx / 12) / (half[a] * half[a]);
    }
    return fall + affine;
  }
};

/// What lies beyond a side of the domain. For cells, and for velocities along the side: the mirror image with
/// the same (even) or the opposite sign (odd, about `value`). For the velocity through the side: fixed at
/// `value` on it (odd), or free (even).
struct MirrorRule {
  bool odd = false;
  SideValue value{};
};

/// Centring and side rules of one component of a field on the hierarchy.
struct Component {
  int normal = -1;  ///< cells, or the axis whose faces carry it (index i: the low face of cell i)
  std::array<MirrorRule, FACES> sides{};
};

/// The nodes of one level. All ranks know all nodes; a parent belongs to the rank of its first leaf.
struct Grid {
  static constexpr int COARSER = -1;  ///< a leaf of the next coarser level lies there
  static constexpr int OUTSIDE = -2;

  struct Node {
    BlockIndex index;
    int owner = 0;
    int leaf = -1;    ///< number in the tree; -1: refined, or beneath the roots
    int local = -1;   ///< position in `local`, -1: another rank's
    int parent = -1;  ///< node of the next coarser grid
    IntVec place{};   ///< where it starts in its parent, cells of the parent
    std::array<int, DIRECTIONS> neighbours{};  ///< node, COARSER or OUTSIDE; at CENTRE the node itself
  };

  Layout layout;
  double dx = 1;
  IntVec extent{};  ///< of the box, nodes
  std::vector<Node> nodes;
  std::vector<int> local;  ///< this rank's nodes

  const Node& mine(int i) const { return nodes[static_cast<std::size_t>(local[static_cast<std::size_t>(i)])]; }
  int size() const { return static_cast<int>(local.size()); }
};

class Hierarchy;

/// Arrays of up to DIM + 1 components on all of this rank's nodes.
class HierarchyField {
 public:
  HierarchyField() = default;
  HierarchyField(const Hierarchy& h, std::vector<Component> components);
  int components() const { return static_cast<int>(components_.size()); }
  const Component& component(int c) const { return components_[static_cast<std::size_t>(c)]; }
  /// Cell (0,0[,0]) of component c in local node i of grid g.
  double* at(int g, int i, int c) { return data_[static_cast<std::size_t>(g)].data() + offset(g, i, c); }
  const double* at(int g, int i, int c) const { return data_[static_cast<std::size_t>(g)].data() + offset(g, i, c); }
  ArrayRef<double> ref(int g, int i, int c);
  ArrayRef<const double> ref(int g, int i, int c) const;
  void clear(int g);
  /// Sets the values of odd side rules.
  void set_side(int c, int face, const SideValue& value) {
    components_[static_cast<std::size_t>(c)].sides[static_cast<std::size_t>(face)].value = value;
  }

 private:
  std::ptrdiff_t offset(int g, int i, int c) const {
    return (static_cast<std::ptrdiff_t>(i) * components() + c) * size_[static_cast<std::size_t>(g)] + origin_[static_cast<std::size_t>(g)];
  }
  std::vector<Component> components_;
  std::vector<Layout> layouts_;
  std::vector<std::ptrdiff_t> size_, origin_;
  std::vector<std::vector<double>> data_;
};

/// First and last index, along its own axis, of the faces of a node that are unknowns of its grid: its low face
/// unless fixed by a wall; its high face only where no node of the same grid lies beyond.
struct Range {
  IntVec lo{}, size{};
};

/// Grid 0 is the finest level of the tree; the next ones are coarser levels, down to the first beneath all leaves that has
/// few enough cells for a direct solution. Where there is none: down to the roots, then roots of half the cells, once at
/// least and while they are many, down to 2; then groups of roots while their number is even along every axis. The last grid
/// is rank 0's.
class Hierarchy {
 public:
  explicit Hierarchy(const Mesh& mesh);

  int grids() const { return static_cast<int>(grids_.size()); }
  int levels() const { return levels_; }  ///< grids that are levels of the tree
  const Grid& grid(int g) const { return grids_[static_cast<std::size_t>(g)]; }
  const Mesh& mesh() const { return mesh_; }
  /// Grid and local node of a local block.
  struct Place {
    int grid, node;
  };
  Place place_of_block(int b) const { return places_[static_cast<std::size_t>(b)]; }

  /// Unknowns of component c in local node i. `composite`: leave out what finer nodes own instead.
  Range unknowns(int g, int i, const Component& c, bool composite) const;

  /// Ghosts of grid g from nodes of the same grid, and beyond the sides; `homogeneous`: side values count as 0.
  void exchange(HierarchyField& f, int g, int depth, bool homogeneous = true);
  /// Ghosts of f on grid g where the next coarser grid has leaves, third order, from `coarse` (may be f) on grid g+1, ghosts of
  /// which must be filled.
  void fill_from_coarser(const HierarchyField& coarse, HierarchyField& f, int g);
  /// Grid g += interpolation of grid g+1: linear, and of the ghosts that fill_from_coarser fills third order. Ghosts of g+1
  /// must be filled.
  void prolong_add(HierarchyField& f, int g);
  /// The same for one component in cells whose share of the neighbour of its parent along axis a, the nearer one, is
  /// component a of `shares` in place of 1/4.
  void prolong_add_shared(HierarchyField& f, const HierarchyField& shares, int g);
  /// Parents in grid g+1 = means of grid g: of the cells, or of the faces that make up a face.
  void restrict_means(const HierarchyField& from, HierarchyField& to, int g);
  /// Parents in grid g+1 = means over the finer faces of a face and of the planes on both its sides (full weighting
  /// along the normal alone), of a vector. made(local node): arrays of its components and of the plane below their
  /// first faces, made when they are asked for.
  void restrict_weighted(const std::function<Array<ArrayRef<const double>>(int i)>& made, HierarchyField& to, int g);
  /// Component c of parents in grid g+1 = the square of the mean of the roots of component 0 (cells) of grid g, of the
  /// CHILDREN cells that begin shift[c] (0 or 1 along each axis) below the first child. Ghosts of grid g must be filled.
  void restrict_roots(HierarchyField& f, int g, std::span<const IntVec> shift);
  /// Faces of parents in grid g+1 as conductors: finer ones in series across the plane, side by side along it. Low planes of
  /// leaves take means, as restrict_means. Ghosts of grid g must be filled.
  void restrict_links(HierarchyField& f, int g);
  /// Parents in grid g+1 = means of the cells that array(local node) holds, made when they are asked for, each once.
  void restrict_made(const std::function<ArrayRef<const double>(int i)>& array, HierarchyField& to, int g);
  /// Ghosts of leaves of grid g+1 beside nodes of grid g, such that the flux of y through the face between is the mean of
  /// the fluxes of x through the finer faces; ghosts of x must be filled. Cells; kappa[a]: component of `coefficients` on
  /// the faces along a, -1: constant.
  void match_fluxes(const HierarchyField& x, HierarchyField& y, int g, const HierarchyField& coefficients, const Array<int>& kappa);
  /// Whether grids from g on have leaves, on any rank.
  bool leaves_from(int g) const { return g <= coarsest_leaf_; }
  /// Leaves have data: fills parents, then all ghosts, so that every leaf sees the composite solution round it.
  /// `parents`: those beneath the coarsest leaves too.
  void make_composite(HierarchyField& f, int depth, bool homogeneous, bool parents = true);

 private:
  // A box of ghosts in arrays of one layout, and where it comes from in the source's array.
  struct GhostCopy {
    std::ptrdiff_t dst = 0, src = 0;
    IntVec size{};
  };
  static constexpr int BOXES = (DIM + 1) * Layout::GHOSTS;  // by normal and depth
  struct GhostBoxes {
    std::array<GhostCopy, BOXES> of;
    const GhostCopy& at(int normal, int depth) const { return of[static_cast<std::size_t>((normal + 1) * Layout::GHOSTS + depth - 1)]; }
  };
  struct Item {
    int dst, src;  // nodes; local numbers where they are ours
    int tag;
    int order;     // agreed on by both sides
    GhostBoxes boxes;  // of Routes::same
  };
  struct Message {
    int rank = 0;
    std::vector<Item> send, recv;
    std::vector<double> send_buffer, recv_buffer;
  };
  struct Route {
    std::vector<Item> local;
    std::vector<Message> messages;
  };
  struct Routes {
    Route same, from_parent, ghosts_from_parent, to_parent, to_plane, to_border;
  };
  void add_level_grids();
  bool end_at_level();
  void add_grids_beneath();
  void connect(int g);
  void build_routes(int g);
  template <class Lists>
  Route make_route(Lists&& lists);
  template <class Size, class Pack, class Unpack, class Direct>
  void run(Route& r, Size&& size, Pack&& pack, Unpack&& unpack, Direct&& direct);
  template <class F>
  void with_parents(const HierarchyField& f, int g, Route& route, F&& use);
  using Parents = std::array<ArrayRef<const double>, DIM + 1>;
  void fill_coarse_ghosts(HierarchyField& f, int g, int i, const Parents& parents, bool add) const;
  GhostBoxes ghost_boxes(const Grid& grid, const Grid::Node& n, int direction) const;
  template <class PlaneValue>
  void restrict_by(const HierarchyField& from, HierarchyField& to, int g, PlaneValue&& value);
  // Of an item of Routes::to_plane: how many faces the plane has in the coarser grid, whether component c has unknowns there,
  // and where it begins.
  IntVec plane_size(int g, const Item& item) const;
  bool plane_is_free(int g, const Item& item, const Component& c) const;
  ArrayRef<double> plane_target(HierarchyField& to, int g, const Item& item, int c) const;
  Range ghost_box(const Grid& grid, const Grid::Node& n, int direction, int normal, int depth) const;
  void apply_sides(HierarchyField& f, int g, int i, int depth, bool homogeneous) const;

  const Mesh& mesh_;
  int rank_;
  int levels_ = 0;
  int coarsest_leaf_ = 0;  // grid
  std::vector<Grid> grids_;
  std::vector<Routes> routes_;
  std::vector<Place> places_;
};

}  // namespace dendrift::amr
