#include "amr/flux_register.hpp"

#include <map>

namespace dendrift::amr {

namespace {
constexpr int TAG = 102;

std::ptrdiff_t face_cells(int n) {
  std::ptrdiff_t v = 1;
  for (int a = 1; a < DIM; ++a) v *= n;
  return v;
}

}  // namespace

void FluxRegister::rebuild() {
  const Tree& tree = mesh_.tree();
  const std::ptrdiff_t per_face = face_cells(mesh_.layout().n);
  offset_.assign(static_cast<std::size_t>(mesh_.size()) * FACES, -1);
  coarse_blocks_.clear();
  messages_.clear();
  std::ptrdiff_t used = 0;
  auto kind_at = [&](int leaf, int face) {
    return tree.neighbour(leaf, direction_index(face_offset(face))).kind;
  };
  for (int b = 0; b < mesh_.size(); ++b) {
    for (int f = 0; f < FACES; ++f) {
      const Neighbour::Kind kind = kind_at(mesh_.block(b).leaf, f);
      if (kind != Neighbour::Kind::coarser && kind != Neighbour::Kind::finer) continue;
      offset_[static_cast<std::size_t>(b * FACES + f)] = used;
      used += per_face;
    }
  }
  values_.assign(static_cast<std::size_t>(used), 0.0);

  // Sender and receiver both walk coarse leaves in order, their faces in order, the fine blocks in order.
  std::map<int, Message> by_rank;
  std::vector<FinerNeighbour> finer;
  auto visit_coarse = [&](int leaf, auto&& f) {
    for (int face = 0; face < FACES; ++face) {
      if (kind_at(leaf, face) != Neighbour::Kind::finer) continue;
      finer.clear();
      tree.finer_neighbours(leaf, direction_index(face_offset(face)), finer);
      for (const FinerNeighbour& n : finer) f(face, n);
    }
  };
  for (int b = 0; b < mesh_.size(); ++b) {
    CoarseBlock c;
    c.b = b;
    visit_coarse(mesh_.block(b).leaf, [&](int face, const FinerNeighbour& n) {
      Part p;
      p.face = face;
      p.child = n.child;
      const int owner = mesh_.owner(n.leaf);
      if (owner == mesh_.rank()) {
        p.values = offset_[static_cast<std::size_t>(mesh_.local(n.leaf) * FACES + (face ^ 1))];
      } else {
        Message& m = by_rank[owner];
        p.message = owner;
        p.packed = m.recv_faces++;
      }
      c.parts.push_back(p);
    });
    if (!c.parts.empty()) coarse_blocks_.push_back(std::move(c));
  }
  for (int leaf = 0; leaf < tree.size(); ++leaf) {
    if (mesh_.owner(leaf) == mesh_.rank()) continue;
    visit_coarse(leaf, [&](int face, const FinerNeighbour& n) {
      const int local = mesh_.local(n.leaf);
      if (local < 0) return;
      by_rank[mesh_.owner(leaf)].sends.push_back(offset_[static_cast<std::size_t>(local * FACES + (face ^ 1))]);
    });
  }
  std::map<int, int> position;
  for (auto& [rank, m] : by_rank) {
    m.rank = rank;
    position[rank] = static_cast<int>(messages_.size());
    messages_.push_back(std::move(m));
  }
  for (CoarseBlock& c : coarse_blocks_)
    for (Part& p : c.parts)
      if (p.message >= 0) p.message = position[p.message];
  generation_ = mesh_.generation();
}

void FluxRegister::restrict_face(const double* fine, double* coarse) const {
  const int n = mesh_.layout().n, h = n / 2;
  if constexpr (DIM == 2) {
    for (int i = 0; i < h; ++i) coarse[i] = 0.5 * (fine[2 * i] + fine[2 * i + 1]);
  } else {
    for (int j = 0; j < h; ++j) {
      const double* f = fine + 2 * j * n;
      for (int i = 0; i < h; ++i)
        coarse[j * h + i] = 0.25 * ((f[2 * i] + f[2 * i + 1]) + (f[n + 2 * i] + f[n + 2 * i + 1]));
    }
  }
}

void FluxRegister::exchange() {
  const std::ptrdiff_t part = face_cells(mesh_.layout().n / 2);
  std::vector<MPI_Request> requests;
  for (Message& m : messages_) {
    m.recv.resize(static_cast<std::size_t>(m.recv_faces * part));
    m.send.resize(m.sends.size() * static_cast<std::size_t>(part));
    if (!m.recv.empty())
      MPI_Irecv(m.recv.data(), static_cast<int>(m.recv.size()), MPI_DOUBLE, m.rank, TAG, mesh_.comm(),
                &requests.emplace_back());
  }
  for (Message& m : messages_) {
    for (std::size_t i = 0; i < m.sends.size(); ++i)
      restrict_face(values_.data() + m.sends[i], m.send.data() + static_cast<std::ptrdiff_t>(i) * part);
    if (!m.send.empty())
      MPI_Isend(m.send.data(), static_cast<int>(m.send.size()), MPI_DOUBLE, m.rank, TAG, mesh_.comm(),
                &requests.emplace_back());
  }
  MPI_Waitall(static_cast<int>(requests.size()), requests.data(), MPI_STATUSES_IGNORE);
}

void FluxRegister::correct(CellField field, double weight) {
  const Layout& layout = mesh_.layout();
  reflux([&](int b, int face, const double* difference) {
    const double w = (face_is_high(face) ? 1 : -1) * weight / mesh_.block(b).dx;
    double* values = mesh_.cells(field, b);
    IntVec lo{}, size = filled(layout.n);
    lo[face_axis(face)] = face_is_high(face) ? layout.n - 1 : 0;
    size[face_axis(face)] = 1;
    for_each_cell(lo, size, [&](const IntVec& cell) { values[layout.offset(cell)] += w * *difference++; });
  });
}

bool FluxRegister::face_difference(const CoarseBlock& c, int face, std::vector<double>& difference) {
  const int n = mesh_.layout().n, h = n / 2;
  const double* own = store(c.b, face);
  if (own == nullptr) return false;
  bool found = false;
  thread_local std::vector<double> restricted;
  for (const Part& p : c.parts) {
    if (p.face != face) continue;
    found = true;
    difference.resize(static_cast<std::size_t>(face_cells(n)));
    const double* mean = nullptr;
    if (p.message >= 0) {
      mean = messages_[static_cast<std::size_t>(p.message)].recv.data() + p.packed * face_cells(h);
    } else {
      restricted.resize(static_cast<std::size_t>(face_cells(h)));
      restrict_face(values_.data() + p.values, restricted.data());
      mean = restricted.data();
    }
    const int axis = face_axis(face);
    const int first = p.child[axis == 0 ? 1 : 0] * h;
    if constexpr (DIM == 2) {
      for (int i = 0; i < h; ++i) difference[static_cast<std::size_t>(first + i)] = mean[i] - own[first + i];
    } else {
      const int second = p.child[axis == 2 ? 1 : 2] * h;
      for (int j = 0; j < h; ++j) {
        for (int i = 0; i < h; ++i) {
          const int to = (second + j) * n + first + i;
          difference[static_cast<std::size_t>(to)] = mean[j * h + i] - own[to];
        }
      }
    }
  }
  return found;
}

}  // namespace dendrift::amr
