# Spack recipe of Dendrift. See packaging/README.md for how to use it from a checkout.
from spack.package import *


class Dendrift(CMakePackage):
    """Alloy dendrites that grow, drift, turn and settle in a flowing melt: block-structured AMR in 2D and 3D with MPI
    and OpenMP."""

    license("BSD-3-Clause")

    # No release yet: the sources are those of a checkout, which `spack develop` names (packaging/README.md).
    version("0.1.0")

    variant("hypre", default=True, description="hypre as a linear solver, for comparison")
    variant("spdlog", default=True, description="Log through spdlog")
    variant("benchmarks", default=False, description="Build dendrift-bench")
    variant("native", default=True, description="Let the compiler use all of this machine's instructions")
    variant("vector_width", default="auto", values=("auto", "none", "128", "256", "512"), multi=False,
            description="Preferred SIMD width in bits")

    depends_on("c", type="build")
    depends_on("cxx", type="build")
    depends_on("cmake@3.22:", type="build")
    depends_on("ninja", type="build")
    depends_on("mpi")
    depends_on("hdf5@1.10: +mpi")
    depends_on("metis@5:")
    depends_on("eigen@3.3:3")
    depends_on("fmt@8:")
    depends_on("cli11@2:")
    depends_on("tomlplusplus@3:")
    depends_on("hypre@2.20: +mpi ~int64", when="+hypre")
    depends_on("spdlog", when="+spdlog")
    depends_on("benchmark", when="+benchmarks")
    depends_on("googletest +gmock", type="test")
    depends_on("python@3.11:", type="run")
    depends_on("py-numpy", type="run")
    depends_on("py-h5py", type="run")
    depends_on("py-matplotlib", type="run")

    conflicts("%gcc@:11", msg="Dendrift needs C++20: GCC 12 or later")

    generator("ninja")

    def cmake_args(self):
        arguments = [
            self.define("DENDRIFT_TESTS", self.run_tests),
            self.define("DENDRIFT_WERROR", False),
            self.define_from_variant("DENDRIFT_BENCHMARKS", "benchmarks"),
            self.define_from_variant("DENDRIFT_VECTOR_WIDTH", "vector_width"),
            # Spack's compiler wrappers add the flags of the target; "native" asks for those of the building machine.
            self.define("DENDRIFT_ARCH", "native" if self.spec.satisfies("+native") else ""),
            self.define("HDF5_ROOT", self.spec["hdf5"].prefix),
            self.define("METIS_ROOT", self.spec["metis"].prefix),
            self.define("CMAKE_DISABLE_FIND_PACKAGE_HYPRE", not self.spec.satisfies("+hypre")),
            self.define("CMAKE_DISABLE_FIND_PACKAGE_spdlog", not self.spec.satisfies("+spdlog")),
        ]
        if self.spec.satisfies("+hypre"):
            arguments.append(self.define("HYPRE_ROOT", self.spec["hypre"].prefix))
        return arguments

    @run_after("install")
    @on_package_attributes(run_tests=True)
    def check_version(self):
        Executable(self.prefix.bin.dendrift)("--version")
