#pragma once

#include <mpi.h>

#include <cstddef>
#include <cstdint>
#include <functional>
#include <span>
#include <string>
#include <vector>

#include "amr/dim.hpp"

/// Plotfiles that ParaView, VisIt and yt read: one HDF5 file per step with the data in Chombo's layout, and
/// VTKHDF's OverlappingAMR layout as virtual datasets over the same numbers. Lengths are in um, times in s.
namespace dendrift::io {

/// The blocks of one level, leaves and parents. The same on all ranks.
struct PlotLevel {
  std::vector<IntVec> blocks;  ///< block coordinates at this level: the block's first cell is n * coordinate
  std::vector<int> owner;      ///< per block, the rank that supplies its data
  std::vector<std::uint8_t> refined;  ///< per block, bit c = x + 2y + 4z: a finer block covers that octant
};

/// What a plotfile says besides the values. The same on all ranks.
struct PlotHeader {
  double time_s = 0;
  std::int64_t step = 0;
  int block_cells = 0;   ///< n, cells along a side of a block; even where blocks are refined
  RealVec origin_um{};   ///< lower corner of the domain
  double dx0_um = 0;     ///< cell width of level 0; level L has dx0_um / 2^L
  IntVec root_blocks{};  ///< blocks of level 0 along each axis
  Array<bool> periodic{};
  std::vector<std::string> fields;  ///< names of the components; "/" and "." are not allowed in them
  std::vector<PlotLevel> levels;    ///< coarsest first, none empty; blocks in the order of the file
};

/// fill(level, index, out) writes the values of block `index` of `level`, which this rank owns: fields.size()
/// components after each other, each of n^DIM cells, i fastest.
using PlotFill = std::function<void(int level, std::size_t index, std::span<double> out)>;

/// Writes `path` under the name path + ".part" and renames it when it is complete. Collective. A failure on
/// any rank throws the same OutputError on every rank and leaves an older file of that name as it was.
void write_plotfile(const std::string& path, const PlotHeader&, const PlotFill& fill, MPI_Comm);

/// Adds a plotfile to ParaView's list of a time series ("plt.hdf.series"), made if it does not exist. Entries
/// at time_s or later, or of the same file, are left out: they are from before a restart. file_name is
/// relative to the list. Not collective: one rank calls it.
void append_series(const std::string& series_path, const std::string& file_name, double time_s);

/// Leaves out of the list, if there is one, what is later than a restart. Not collective.
void cut_series(const std::string& series_path, double last_time_s);

}  // namespace dendrift::io
