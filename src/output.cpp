#include "output.hpp"

#include <map>

#include "amr/transfer.hpp"

namespace dendrift {

namespace {

constexpr int TAG = 110;

struct Node {
  amr::BlockIndex index;
  int owner = 0;
  int leaf = -1;       // -1: a parent
  std::size_t parent = 0;  // position on the level above
};

amr::BlockIndex parent_of(amr::BlockIndex b) {
  --b.level;
  for (int& c : b.coord) c >>= 1;
  return b;
}

// Every node of the tree by level, each level along the Morton curve; a parent belongs to the rank of its first leaf.
std::vector<std::vector<Node>> nodes_by_level(const amr::Mesh& mesh) {
  std::vector<std::vector<Node>> levels(static_cast<std::size_t>(mesh.tree().finest_level()) + 1);
  for (int i = 0; i < mesh.tree().size(); ++i) {
    Node n{mesh.tree().leaf(i), mesh.owner(i), i, 0};
    while (true) {
      std::vector<Node>& level = levels[static_cast<std::size_t>(n.index.level)];
      if (!level.empty() && level.back().index == n.index) break;
      level.push_back(n);
      if (n.index.level == 0) break;
      n = {parent_of(n.index), mesh.owner(i), -1, 0};
    }
  }
  for (std::size_t l = 1; l < levels.size(); ++l) {
    std::size_t p = 0;
    for (Node& n : levels[l]) {
      const amr::BlockIndex parent = parent_of(n.index);
      while (levels[l - 1][p].index != parent) ++p;
      n.parent = p;
    }
  }
  return levels;
}

// Data of the nodes this rank owns, component-major, by level and position.
class NodeData {
 public:
  NodeData(const amr::Mesh& mesh, const std::vector<PlotComponent>& components)
      : mesh_(mesh), components_(components), levels_(nodes_by_level(mesh)), data_(levels_.size()) {
    cells_ = static_cast<std::size_t>(volume(filled(mesh.layout().n)));
    for (std::size_t l = levels_.size(); l-- > 0;) {
      fill_leaves(l);
      if (l > 0) send_means_up(l);
    }
  }
  const std::vector<std::vector<Node>>& levels() const { return levels_; }
  const std::vector<double>& at(std::size_t level, std::size_t position) const { return data_[level].at(position); }

 private:
  void fill_leaves(std::size_t l) {
    for (std::size_t i = 0; i < levels_[l].size(); ++i) {
      const Node& n = levels_[l][i];
      if (n.leaf < 0 || n.owner != mesh_.rank()) continue;
      std::vector<double>& d = data_[l][i];
      d.resize(cells_ * components_.size());
      for (std::size_t f = 0; f < components_.size(); ++f)
        components_[f].values(mesh_.local(n.leaf), std::span(d).subspan(f * cells_, cells_));
    }
  }

  void place(std::size_t l, const Node& n, const double* means) {
    const IntVec whole = filled(mesh_.layout().n), half = filled(mesh_.layout().n / 2);
    IntVec corner{};
    for (int a = 0; a < DIM; ++a) corner[a] = (n.index.coord[a] & 1) * half[a];
    std::vector<double>& d = data_[l - 1][n.parent];
    d.resize(cells_ * components_.size());
    for (std::size_t f = 0; f < components_.size(); ++f)
      amr::copy_box(amr::packed_ref(d.data() + f * cells_, whole), corner,
                    amr::packed_ref(means + f * cells_ / CHILDREN, half), {}, half);
  }

  void send_means_up(std::size_t l) {
    const IntVec whole = filled(mesh_.layout().n), half = filled(mesh_.layout().n / 2);
    const std::size_t each = cells_ / CHILDREN * components_.size();
    std::map<int, std::vector<double>> sends, receives;
    std::vector<double> means(each);
    auto restricted = [&](std::size_t i, double* out) {
      for (std::size_t f = 0; f < components_.size(); ++f)
        amr::restrict_box(amr::packed_ref(out + f * cells_ / CHILDREN, half), {},
                          amr::packed_ref(static_cast<const double*>(data_[l].at(i).data()) + f * cells_, whole), {}, half);
    };
    for (std::size_t i = 0; i < levels_[l].size(); ++i) {
      const Node& n = levels_[l][i];
      const int to = levels_[l - 1][n.parent].owner;
      if (n.owner == mesh_.rank() && to == mesh_.rank()) {
        restricted(i, means.data());
        place(l, n, means.data());
      } else if (n.owner == mesh_.rank()) {
        std::vector<double>& b = sends[to];
        b.resize(b.size() + each);
        restricted(i, b.data() + b.size() - each);
      } else if (to == mesh_.rank()) {
        std::vector<double>& b = receives[n.owner];
        b.resize(b.size() + each);
      }
    }
    std::vector<MPI_Request> requests;
    for (auto& [rank, b] : receives)
      MPI_Irecv(b.data(), static_cast<int>(b.size()), MPI_DOUBLE, rank, TAG, mesh_.comm(), &requests.emplace_back());
    for (auto& [rank, b] : sends)
      MPI_Isend(b.data(), static_cast<int>(b.size()), MPI_DOUBLE, rank, TAG, mesh_.comm(), &requests.emplace_back());
    MPI_Waitall(static_cast<int>(requests.size()), requests.data(), MPI_STATUSES_IGNORE);
    std::map<int, std::size_t> read;
    for (const Node& n : levels_[l]) {
      if (n.owner == mesh_.rank() || levels_[l - 1][n.parent].owner != mesh_.rank()) continue;
      place(l, n, receives[n.owner].data() + read[n.owner]);
      read[n.owner] += each;
    }
  }

  const amr::Mesh& mesh_;
  const std::vector<PlotComponent>& components_;
  std::vector<std::vector<Node>> levels_;
  std::vector<std::map<std::size_t, std::vector<double>>> data_;
  std::size_t cells_ = 0;
};

}  // namespace

void write_plot(const std::string& path, const amr::Mesh& mesh, const physics::Scales& scales, double time_s,
                std::int64_t step, const std::vector<PlotComponent>& components) {
  const NodeData nodes(mesh, components);
  io::PlotHeader h;
  h.time_s = time_s;
  h.step = step;
  h.block_cells = mesh.layout().n;
  for (int a = 0; a < DIM; ++a) h.origin_um[a] = mesh.shape().lo[a] * scales.w0_um;
  h.dx0_um = mesh.shape().root_dx * scales.w0_um;
  h.root_blocks = mesh.shape().root_blocks;
  h.periodic = mesh.shape().periodic();
  for (const PlotComponent& c : components) h.fields.push_back(c.name);
  for (const std::vector<Node>& level : nodes.levels()) {
    io::PlotLevel& p = h.levels.emplace_back();
    for (const Node& n : level) {
      p.blocks.push_back(n.index.coord);
      p.owner.push_back(n.owner);
      p.refined.push_back(n.leaf < 0 ? static_cast<std::uint8_t>((1U << CHILDREN) - 1) : 0);
    }
  }
  io::write_plotfile(path, h, [&](int level, std::size_t index, std::span<double> out) {
    const std::vector<double>& d = nodes.at(static_cast<std::size_t>(level), index);
    std::copy(d.begin(), d.end(), out.begin());
  }, mesh.comm());
}

}  // namespace dendrift
