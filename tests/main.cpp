// Runs the GoogleTest suites between MPI_Init and MPI_Finalize; a failure on any rank fails on all of them.
#include <gtest/gtest.h>
#include <mpi.h>

#include <cstdio>
#include <cstdlib>
#include <filesystem>
#include <string>

namespace {

/// All that a rank other than 0 has to say: its failures, each in one piece so that ranks do not interleave.
class FailuresOfRank : public ::testing::EmptyTestEventListener {
 public:
  explicit FailuresOfRank(int rank) : rank_(rank) {}
  void OnTestStart(const ::testing::TestInfo& test) override {
    test_ = std::string(test.test_suite_name()) + "." + test.name();
  }
  void OnTestPartResult(const ::testing::TestPartResult& result) override {  // GoogleTest is locked meanwhile
    if (!result.failed()) return;
    std::string text = "[rank " + std::to_string(rank_) + "] " + test_;
    if (result.file_name() != nullptr) {
      text += std::string(" ") + result.file_name() + ":" + std::to_string(result.line_number());
    }
    text += std::string(": Failure\n") + result.message() + "\n";
    std::fputs(text.c_str(), stdout);
    std::fflush(stdout);
  }

 private:
  int rank_;
  std::string test_ = "outside of tests";
};

}  // namespace

int main(int argc, char** argv) {
  ::testing::InitGoogleTest(&argc, argv);
  if (GTEST_FLAG_GET(list_tests)) return RUN_ALL_TESTS();  // CTest asks for the names; no MPI needed
  // Tests run side by side, each in a process of its own: without a folder of its own for Open MPI's session files, one
  // that ends would remove those of one that starts.
  std::string session = (std::filesystem::temp_directory_path() / "dendrift_test_XXXXXX").string();
  const bool alone = std::getenv("OMPI_COMM_WORLD_SIZE") == nullptr && mkdtemp(session.data()) != nullptr;
  if (alone) setenv("OMPI_MCA_orte_tmpdir_base", session.c_str(), 1);

  int provided = 0, rank = 0, ranks = 1;
  MPI_Init_thread(&argc, &argv, MPI_THREAD_FUNNELED, &provided);
  MPI_Comm_rank(MPI_COMM_WORLD, &rank);
  MPI_Comm_size(MPI_COMM_WORLD, &ranks);
  if (rank > 0) {
    ::testing::TestEventListeners& listeners = ::testing::UnitTest::GetInstance()->listeners();
    delete listeners.Release(listeners.default_result_printer());
    delete listeners.Release(
        listeners.default_xml_generator());  // one report is enough; null if none was asked for
    listeners.Append(new FailuresOfRank(rank));
  }
  // An exception on one rank would leave the others waiting in a collective call: let it end the whole job.
  if (ranks > 1) GTEST_FLAG_SET(catch_exceptions, false);

  const int mine = RUN_ALL_TESTS();
  int worst = 0;
  MPI_Allreduce(&mine, &worst, 1, MPI_INT, MPI_MAX, MPI_COMM_WORLD);
  if (rank == 0 && mine == 0 && worst != 0) std::puts("[  FAILED  ] on another rank");
  MPI_Finalize();
  std::error_code ignored;
  if (alone) std::filesystem::remove_all(session, ignored);
  return worst;
}
