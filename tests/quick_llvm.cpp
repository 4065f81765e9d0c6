// Stands before libLLVM when Dr.Jit looks up its functions, and asks it for less work: see
// quick_kernels.py. The types are LLVM's opaque pointers and enumerations.

#ifndef _GNU_SOURCE
#    define _GNU_SOURCE
#endif
#include <dlfcn.h>

// The function of that name in libLLVM, which is linked after this library.
template <typename Function> static Function *next(Function *, const char *name) {
    return reinterpret_cast<Function *>(dlsym(RTLD_NEXT, name));
}

extern "C" {

// Passes over the intermediate code: only those that must run.
void *LLVMRunPasses(void *module, const char *, void *machine, void *options) {
    return next(LLVMRunPasses, "LLVMRunPasses")(module, "default<O0>", machine, options);
}

// Selection of instructions and allocation of registers, without search (level 0 of 3).
void *LLVMCreateTargetMachine(void *target, const char *triple, const char *cpu,
                              const char *features, int, int relocation, int code_model) {
    return next(LLVMCreateTargetMachine, "LLVMCreateTargetMachine")(
        target, triple, cpu, features, 0, relocation, code_model);
}
}
