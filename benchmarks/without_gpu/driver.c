/* A CUDA driver for a computer without a GPU: its memory is the computer's own, and a launch is handed to whoever has
   called `launch_by`, or does nothing. It knows the calls that Numba makes for memory, kernels and events; all others
   succeed and do nothing. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

typedef int Result; /* 0: success */
typedef uint64_t Pointer;
typedef Result (*Launch)(const char *name, const unsigned *blocks, const unsigned *threads, void **arguments);

enum { LAUNCHES, UPLOADS, DOWNLOADS, COUNTS };
static long counts[COUNTS];
static Launch launch;
static int context;
static void *const CONTEXT = &context;
static int current;

void launch_by(Launch given) { launch = given; }

/* How often was launched, uploaded and downloaded since the last call. */
void take_counts(long *into) {
    memcpy(into, counts, sizeof counts);
    memset(counts, 0, sizeof counts);
}

/* --- the device: as an H100 describes itself, where that is asked for ------------------------------------------- */

Result cuInit(unsigned flags) { return 0; }
Result cuDriverGetVersion(int *version) { return *version = 12090, 0; }
Result cuDeviceGetCount(int *count) { return *count = 1, 0; }
Result cuDeviceGet(int *device, int number) { return *device = number, 0; }
Result cuDeviceGetName(char *name, int size, int device) { return snprintf(name, size, "none"), 0; }
Result cuDeviceGetUuid_v2(void *uuid, int device) { return memset(uuid, 1, 16), 0; }
Result cuDeviceGetAttribute(int *value, int attribute, int device) {
    static const int known[][2] = {{1, 1024},  {2, 1024},  {3, 1024}, {4, 64}, {5, 2147483647}, {6, 65535},  {7, 65535},
                                   {8, 49152}, {10, 32},   {12, 65536}, {16, 132}, {39, 2048}, {75, 9}, {76, 0}};
    *value = 0;
    for (size_t i = 0; i < sizeof known / sizeof *known; i++)
        if (known[i][0] == attribute) *value = known[i][1];
    return 0;
}
Result cuDevicePrimaryCtxRetain(void **given, int device) { return *given = CONTEXT, 0; }
Result cuCtxGetCurrent(void **given) { return *given = current ? CONTEXT : NULL, 0; }
Result cuCtxSetCurrent(void *given) { return current = given != NULL, 0; }
Result cuCtxPushCurrent_v2(void *given) { return current = 1, 0; }
Result cuCtxPopCurrent_v2(void **given) { return *given = CONTEXT, current = 0, 0; }
Result cuCtxGetDevice(int *device) { return *device = 0, 0; }

/* --- memory ------------------------------------------------------------------------------------------------------- */

static void *room(size_t size) {
    void *found = NULL;
    return posix_memalign(&found, 256, size + !size) ? NULL : memset(found, 0xFF, size); /* nobody relies on it */
}
Result cuMemAlloc_v2(Pointer *given, size_t size) { return (*given = (Pointer)room(size)) ? 0 : 2; }
Result cuMemAllocAsync(Pointer *given, size_t size, void *stream) { return cuMemAlloc_v2(given, size); }
Result cuMemFree_v2(Pointer at) { return free((void *)at), 0; }
Result cuMemFreeAsync(Pointer at, void *stream) { return cuMemFree_v2(at); }
Result cuMemHostAlloc(void **given, size_t size, unsigned flags) { return (*given = room(size)) ? 0 : 2; }
Result cuMemFreeHost(void *at) { return free(at), 0; }
Result cuMemGetInfo_v2(size_t *left, size_t *all) { return *left = *all = (size_t)8 << 30, 0; }
Result cuPointerGetAttribute(Pointer *value, int attribute, Pointer at) {
    if (attribute == 2) return *(int *)value = 2, 0; /* the memory is a device's */
    return *value = at, 0;
}
Result cuMemcpyHtoD_v2(Pointer to, const void *from, size_t size) {
    counts[UPLOADS]++;
    return memcpy((void *)to, from, size), 0;
}
Result cuMemcpyDtoH_v2(void *to, Pointer from, size_t size) {
    counts[DOWNLOADS]++;
    return memcpy(to, (void *)from, size), 0;
}
Result cuMemcpyDtoD_v2(Pointer to, Pointer from, size_t size) { return memmove((void *)to, (void *)from, size), 0; }
Result cuMemcpyHtoDAsync_v2(Pointer to, const void *from, size_t size, void *stream) {
    return cuMemcpyHtoD_v2(to, from, size);
}
Result cuMemcpyDtoHAsync_v2(void *to, Pointer from, size_t size, void *stream) { return cuMemcpyDtoH_v2(to, from, size); }
Result cuMemcpyDtoDAsync_v2(Pointer to, Pointer from, size_t size, void *stream) {
    return cuMemcpyDtoD_v2(to, from, size);
}

/* --- kernels: what is known of one is its name -------------------------------------------------------------------- */

Result cuLibraryLoadData(void **library, const void *code, void *a, void *b, unsigned c, void *d, void *e, unsigned f) {
    return *library = (void *)code, 0;
}
Result cuLibraryGetKernel(void **kernel, void *library, const char *name) { return (*kernel = strdup(name)) ? 0 : 2; }
Result cuKernelGetFunction(void **function, void *kernel) { return *function = kernel, 0; }
Result cuKernelGetAttribute(int *value, int attribute, void *kernel, int device) {
    return *value = attribute ? 0 : 1024, 0; /* 0: the most threads of a block */
}
Result cuFuncGetAttribute(int *value, int attribute, void *function) {
    return cuKernelGetAttribute(value, attribute, function, 0);
}
Result cuLaunchKernelEx(const unsigned *shape, void *function, void **arguments, void **extra) {
    counts[LAUNCHES]++;
    return launch ? launch(function, shape, shape + 3, arguments) : 0;
}
Result cuEventCreate(void **event, unsigned flags) { return (*event = malloc(1)) ? 0 : 2; }
Result cuStreamCreate(void **stream, unsigned flags) { return (*stream = malloc(1)) ? 0 : 2; }
Result cuGetErrorName(int error, const char **name) { return *name = "CUDA_ERROR_UNKNOWN", 0; }
Result cuGetErrorString(int error, const char **text) { return *text = "a launch failed", 0; }

static Result done(void) { return 0; }

Result cuGetProcAddress_v2(const char *symbol, void **found, int version, uint64_t flags, int *status) {
    static void *here;
    char newer[128];
    Dl_info me;
    if (!here && dladdr((void *)cuInit, &me)) here = dlopen(me.dli_fname, RTLD_NOW);
    snprintf(newer, sizeof newer, "%s_v2", symbol);
    if (!(*found = dlsym(here, newer)) && !(*found = dlsym(here, symbol))) *found = (void *)done;
    if (status) *status = 0;
    return 0;
}
Result cuGetProcAddress(const char *symbol, void **found, int version, uint64_t flags) {
    return cuGetProcAddress_v2(symbol, found, version, flags, NULL);
}
