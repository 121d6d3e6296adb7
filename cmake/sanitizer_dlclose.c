/* Linked into the programs of sanitizer builds: a library that MPI has loaded stays loaded, so that the reports
   about it carry its name and cmake/lsan.supp and cmake/tsan.supp can match it. */
int dlclose(void* handle);
int dlclose(void* handle) {
  (void)handle;
  return 0;
}
