/*
 * In place of netem/uml_registers.c: says that there is no more of a process's registers than what x86-64 began with,
 * so that User Mode Linux keeps no more.
 */

typedef long ptrace_function(int request, int pid, void *address, void *data);

extern void *dlsym(void *handle, const char *name);
extern int *__errno_location(void);

#define RTLD_NEXT ((void *)-1L)
#define PTRACE_GETREGSET 0x4204
#define EIO 5

long ptrace(int request, int pid, void *address, void *data)
{
	ptrace_function *next = (ptrace_function *)dlsym(RTLD_NEXT, "ptrace");

	if (request == PTRACE_GETREGSET) {
		*__errno_location() = EIO;
		return -1;
	}
	return next(request, pid, address, data);
}
