#!/usr/bin/python3
"""The Spack recipe and the Apptainer definition, as far as they can be checked without Spack and Apptainer: syntax,
options and versions against CMake, files, packages and libraries against this machine where it is a Debian 12."""
import ast
import re
import subprocess
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent / "lib"))
from support import BUILD, SOURCE, fail, require, say

OPTIONS = (SOURCE / "cmake/DendriftOptions.cmake").read_text()
DEPENDENCIES = (SOURCE / "cmake/DendriftDependencies.cmake").read_text()
# Packages of CMake and what Spack calls them; OpenMP comes with the compiler.
SPACK_NAMES = {"MPI": "mpi", "HDF5Parallel": "hdf5", "METIS": "metis", "fmt": "fmt", "CLI11": "cli11",
               "TomlPlusPlus": "tomlplusplus", "spdlog": "spdlog", "Eigen3": "eigen", "HYPRE": "hypre",
               "GTest": "googletest", "benchmark": "benchmark"}


def options():
    """Names of our CMake options, and the values allowed in those that list them."""
    names = dict.fromkeys(re.findall(r"^option\((DENDRIFT_\w+)", OPTIONS, re.M), {"ON", "OFF"})
    for name in re.findall(r"^set\((DENDRIFT_\w+) \"[^\"]*\" CACHE STRING", OPTIONS, re.M):
        names[name] = None
    require(len(names) == 6, f"options found in DendriftOptions.cmake: {sorted(names)}")
    return names


class Spec:
    """Stands for Spack's spec of a variant's setting."""

    def __init__(self, settings):
        self.settings = settings

    def satisfies(self, text):
        return bool(self.settings[text[1:]]) == (text[0] == "+")

    def __getitem__(self, name):
        self.prefix = f"/prefix/{name}"
        return self


def run_recipe(text):
    """What the recipe declares, and the class, with functions in the place of Spack's."""
    declared = {"depends_on": [], "variant": {}, "version": [], "license": []}

    class CMakePackage:
        run_tests = False

        def define(self, name, value):
            return name, {True: "ON", False: "OFF"}.get(value, str(value)) if isinstance(value, bool) else str(value)

        def define_from_variant(self, name, variant):
            return self.define(name, self.spec.settings[variant])

    def decorator(*_, **__):
        return lambda function: function

    names = {
        "CMakePackage": CMakePackage, "run_after": decorator, "on_package_attributes": decorator,
        "depends_on": lambda spec, **options: declared["depends_on"].append((spec, options)),
        "variant": lambda name, **options: declared["variant"].update({name: options}),
        "version": lambda number, **_: declared["version"].append(number),
        "license": lambda name: declared["license"].append(name),
        "conflicts": lambda *_, **__: None, "generator": lambda *_: None}
    exec(compile(text.replace("from spack.package import *", ""), "package.py", "exec"), names)
    return declared, names["Dendrift"]


def check_spack():
    path = SOURCE / "packaging/spack/package.py"
    text = path.read_text()
    ast.parse(text)
    require(text.count("from spack.package import *") == 1, "package.py does not import spack.package")
    declared, recipe = run_recipe(text)
    version = re.search(r"project\(dendrift VERSION ([\d.]+)", (SOURCE / "CMakeLists.txt").read_text())[1]
    require(version in declared["version"], f"the recipe has no version {version}: {declared['version']}")
    require(declared["license"] == ["BSD-3-Clause"], f"licence {declared['license']}")

    names = {re.match(r"[\w-]+", spec)[0]: options for spec, options in declared["depends_on"]}
    required = re.findall(r"find_package\((\w+)", DEPENDENCIES)
    for package in required:
        if package != "OpenMP":
            require(SPACK_NAMES.get(package) in names, f"the recipe does not depend on {package}")
    for package in re.findall(r"find_package\((\w+)[^)]*REQUIRED", DEPENDENCIES):
        require("when" not in names.get(SPACK_NAMES.get(package), {}), f"{package} is required, not a variant")
    conditions = [o["when"] for o in names.values() if "when" in o]
    require({c.strip("+~") for c in conditions} <= set(declared["variant"]), f"conditions {conditions}")

    # Every combination of variants: the options that CMake is given
    known, count = options(), 0
    switches = [n for n, o in declared["variant"].items() if "values" not in o]
    for bits in range(2**len(switches)):
        for width in declared["variant"]["vector_width"]["values"]:
            package = recipe()
            package.spec = Spec({"vector_width": width, **{n: bool(bits >> i & 1) for i, n in enumerate(switches)}})
            for name, value in package.cmake_args():
                if name.startswith("DENDRIFT_"):
                    require(name in known, f"CMake has no option {name}")
                    require(known[name] is None or value in known[name], f"{name}={value}")
                else:
                    package_name = re.match(r"CMAKE_DISABLE_FIND_PACKAGE_(\w+)$|(\w+)_ROOT$", name)
                    require(package_name, f"what is {name}?")
                    package_name = package_name[1] or package_name[2].replace("HDF5", "HDF5Parallel")
                    require(package_name in required, f"{name}: CMake looks for no {package_name}")
                count += 1
    help_text = re.search(r"set\(DENDRIFT_VECTOR_WIDTH.*?\"(Preferred.*?)\"", OPTIONS, re.S)[1]
    for width in declared["variant"]["vector_width"]["values"]:
        require(re.search(rf"\b{width}\b", help_text), f"DENDRIFT_VECTOR_WIDTH={width}")
    readme = (SOURCE / "packaging/README.md").read_text()
    for name in declared["variant"]:
        require(f"| `{name}` |" in readme, f"packaging/README.md lacks the variant {name}")
    say(f"spack: version, {len(names)} dependencies, {count} settings of CMake options")


def sections(text):
    """Stages of the definition: the header, and (name, words, body) of each section."""
    stages = []
    for stage in re.split(r"^(?=Bootstrap:)", text, flags=re.M)[1:]:
        parts = re.split(r"^%", stage, flags=re.M)
        stages.append((parts[0], [(p.split()[0], p.split("\n")[0].split()[1:], p.partition("\n")[2])
                                  for p in parts[1:]]))
    return stages


def check_apptainer():
    stages = sections((SOURCE / "packaging/apptainer/dendrift.def").read_text())
    require([re.search(r"^Stage: (\w+)", head, re.M)[1] for head, _ in stages] == ["build", "final"], "stages")
    known = {"arguments", "files", "post", "environment", "runscript", "test", "labels", "help"}
    shells, copied = 0, 0
    for head, parts in stages:
        require(re.search(r"^From: debian:12$", head, re.M), f"another system than Debian 12: {head}")
        for name, words, body in parts:
            require(name in known, f"unknown section %{name}")
            if name in ("post", "environment", "runscript", "test"):
                done = subprocess.run(["bash", "-n"], input=body, text=True, capture_output=True)
                require(done.returncode == 0 and not done.stderr, f"%{name}: {done.stderr}")
                shells += 1
                for option in re.findall(r"-D(DENDRIFT_\w+)", body):
                    require(option in options(), f"CMake has no option {option}")
            if name == "files" and not words:
                for line in body.split("\n"):
                    if line.strip():
                        require((SOURCE / line.split()[0]).exists(), f"%files: no {line.split()[0]}")
                        copied += 1
    build = "".join(body for name, _, body in stages[0][1] if name == "post")
    for argument in re.findall(r"{{ *(\w+) *}}", build):
        require(re.search(rf"^ *{argument}=", stages[0][1][0][2], re.M), f"no default of {argument}")
    for file in ("CMakeLists.txt", "cmake", "src", "tools", "inputs", "LICENSE"):
        require(any(re.search(rf"^ *{file} /source/", b, re.M) for n, _, b in stages[0][1] if n == "files"),
                f"the build stage lacks {file}, which CMake needs")
    say(f"apptainer: {shells} shell parts, {copied} files, options of CMake")
    return next(body for name, _, body in stages[1][1] if name == "post")


def check_packages(post):
    """On a Debian 12: the packages of the image exist, and the libraries that the programs load are in them or in
    what they depend on."""
    system = Path("/etc/os-release")
    if not system.exists() or 'VERSION_ID="12"' not in system.read_text() or "ID=debian" not in system.read_text():
        say("packages: not a Debian 12, not checked")
        return
    packages = re.search(r"--no-install-recommends((?:[^\n]*\\\n)*[^\n]*)", post)[1].replace("\\\n", " ").split()
    wanted, queue = set(), list(packages)
    while queue:
        name = queue.pop()
        if name in wanted:
            continue
        status = Path("/var/lib/dpkg/status")
        wanted.add(name)
        queue += depends(status).get(name, [])
    missing = [p for p in packages if p not in depends(Path("/var/lib/dpkg/status"))]
    shown = subprocess.run(["apt-cache", "show", "--no-all-versions", *missing], capture_output=True, text=True)
    unknown = set(missing) - set(re.findall(r"^Package: (\S+)", shown.stdout, re.M))
    require(not unknown, f"Debian has no packages {sorted(unknown)}")
    count = 0
    for program in ("dendrift", "dendrift2d", "dendrift3d"):
        text = subprocess.run(["ldd", BUILD / program], capture_output=True, text=True).stdout
        for line in re.findall(r"=> (/\S+)", text):
            owner = subprocess.run(["dpkg", "-S", Path(line).resolve()], capture_output=True, text=True).stdout
            owner = owner.partition(":")[0]
            if not owner:
                continue  # not from a package: a library of a sanitizer or the user's own
            sanitizer = re.match(r"lib(asan|ubsan|tsan|omp)", owner)
            require(owner in wanted or sanitizer, f"{program} loads {line} of {owner}, which the image does not install")
            count += 1
    if count == 0:
        fail("ldd named no libraries")
    say(f"packages: {len(packages)} with their dependencies hold the {count} libraries that the programs load")


def depends(status, cache={}):
    """Package: what it depends on, of the installed ones, alternatives and provided names included."""
    if not cache:
        provides = {}
        for entry in status.read_text(errors="replace").split("\n\n"):
            fields = dict(re.findall(r"^(Package|Depends|Pre-Depends|Provides|Status): (.*)$", entry, re.M))
            if "install ok installed" not in fields.get("Status", ""):
                continue
            words = re.findall(r"(?:^|[,|] ?)([a-z0-9][a-z0-9.+-]*)",
                               f"{fields.get('Depends', '')}, {fields.get('Pre-Depends', '')}")
            cache[fields["Package"]] = words
            for name in re.findall(r"(?:^|, ?)([a-z0-9][a-z0-9.+-]*)", fields.get("Provides", "")):
                provides.setdefault(name, []).append(fields["Package"])
        for name, packages in provides.items():
            cache.setdefault(name, []).extend(packages)
    return cache


check_spack()
check_packages(check_apptainer())
